"""Tracking of one source or several through time."""
