"""Maps over cubes of points, computed on one machine or many and streamed to disk."""
