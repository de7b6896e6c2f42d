"""Joint fit of a survey: rows, whitening, sources and backgrounds."""
