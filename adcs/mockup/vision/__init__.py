"""From the light on the camera to a fix: camera, centroids, triangles, matchers."""
