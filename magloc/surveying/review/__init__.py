"""Review of a survey: decisions about its targets and rows, and fits that follow them."""
