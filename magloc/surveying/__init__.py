"""Static targets from sensors that move: all rows of a survey together."""
