"""Viewer of results in three dimensions, in a browser (viser)."""

from arrays.io.errors import of_extra
from arrays.io.lazy import lazy_names

with of_extra("view", "the viewer"):
    import trimesh as trimesh
    import viser as viser
    import websockets as websockets

__getattr__, __dir__, __all__ = lazy_names(__name__, {"LiveView": "magloc.viewer.live_view"})
