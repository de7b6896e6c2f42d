"""Cubes of points, swept on one machine or many, streamed to disk."""
