"""From sources to what an array measures."""
