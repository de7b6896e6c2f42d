"""Searches for the optima of the likelihood, without a start."""
