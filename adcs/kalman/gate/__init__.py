"""Readings that contradict a filter, and the second hypothesis that they begin."""
