import trimesh as trimesh
import viser as viser
import websockets as websockets

from magloc.viewer.live_view import LiveView as LiveView
