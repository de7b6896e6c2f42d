"""Fixes from images: camera, centroids, triangles, matchers."""
