"""Filters besides the error-state filter itself: of one gain, of fewer states, of two parts, of a bank."""
