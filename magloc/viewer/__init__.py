"""Results seen in three dimensions, in a browser (viser)."""

from arrays.io.errors import of_extra

with of_extra("view", "the viewer"):
    import trimesh as trimesh
    import viser as viser
    import websockets as websockets
