"""Cramér-Rao bounds: what an array can know."""
