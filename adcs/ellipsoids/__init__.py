"""Guaranteed state ellipsoids under bounded noise."""
