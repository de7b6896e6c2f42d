"""Terrain: the ground below a survey, and the files that describe it."""
