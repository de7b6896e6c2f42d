"""Runs that simulate and estimate; what repeats the papers."""
