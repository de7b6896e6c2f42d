"""Tracks of whole records: smoother, background, bounds and tests."""
