"""Mixture filter of one source: start, split, update, merge, refit."""
