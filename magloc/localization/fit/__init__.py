"""Fits of dipoles: iterations, results and their columns."""
