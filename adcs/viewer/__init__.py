"""Attitude results seen in three dimensions, in a browser."""
