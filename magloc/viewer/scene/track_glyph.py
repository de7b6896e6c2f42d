"""Track in a scene, coloured by time, with a bounded number of points."""

from __future__ import annotations

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arrays.typing import ByteArray, FloatArray
from magloc.viewer.scene.glyphs import TRACK_COLOUR, Colour, SurfaceGlyph, add_lines
from magloc.viewer.scene.shapes import ellipsoid, ellipsoid_axes, surface_of

_MOST_ELLIPSOIDS = 40
_MOST_SEGMENTS = 500
_SUBDIVISIONS = 2  # of the ellipsoids: with 3 a frame takes 50 % longer without a graphics card


class TrackGlyph:
    """Track in a scene: line, 95 % ellipsoids of some points, and mark at one time.

    Parameters
    ----------
    scene : viser.SceneApi
    name : str
        Name of the parent node.
    positions_m : ndarray, shape (n, 3)
        Positions [m], NaN where the source is not tracked.
    covariances_m2 : ndarray, shape (n, 3, 3), optional
        Covariances of the positions [m²]; without them there are no ellipsoids.
    size_m : float
        Diameter of the mark [m].
    colour : tuple of 3 ints
        Colour of mark and ellipsoids.
    colours : ndarray of uint8, shape (n, 3), optional
        Colours of the line at its points; by default that of the mark.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        positions_m: FloatArray,
        covariances_m2: FloatArray | None = None,
        *,
        size_m: float,
        colour: Colour = TRACK_COLOUR,
        colours: ByteArray | None = None,
    ) -> None:
        self.positions_m, self.covariances_m2 = positions_m, covariances_m2
        self._scene, self._name, self._colour = scene, name, colour
        every = np.tile(np.array(colour, dtype=np.uint8), (len(positions_m), 1)) if colours is None else colours
        self._colours = linear_intensities(every)
        ends = track_segments(positions_m, 0, len(positions_m) - 1)
        self.line = add_lines(scene, f"{name}/line", positions_m[ends], self._colours[ends], 4.0)
        self.mark = scene.add_icosphere(
            f"{name}/mark", radius=0.5 * size_m, color=colour, visible=False, cast_shadow=False, receive_shadow=False
        )
        self.region = SurfaceGlyph(scene, f"{name}/region-now", colour, 0.3)
        self.regions: viser.BatchedMeshHandle | None = None
        if covariances_m2 is not None:
            self._add_ellipsoids(covariances_m2)

    def show_until(self, index: int, tail: int) -> None:
        """Show a tail of some intervals up to a point, which has a mark and an ellipsoid.

        Call this within ``server.atomic()``, because the changes belong together.
        """
        first, position = max(0, index - tail), self.positions_m[index]
        ends = track_segments(self.positions_m, first, index)
        self.line.visible = bool(len(ends))
        if len(ends):
            self.line.points, self.line.colors = self.positions_m[ends].astype(np.float32), self._colours[ends]
        self.mark.visible = bool(np.isfinite(position).all())
        if self.mark.visible:
            self.mark.position = position
        self.region.show(None if self.covariances_m2 is None else ellipsoid(position, self.covariances_m2[index]))
        if self.regions is not None:
            # The number of ellipsoids cannot change, so hidden ones get a size of zero.
            is_shown = (self._chosen >= first) & (self._chosen <= index)
            self.regions.batched_scales = np.where(is_shown[:, None], self._semi_axes, 0.0).astype(np.float32)

    def _add_ellipsoids(self, covariances_m2: FloatArray) -> None:
        """Add one node for the ellipsoids, at most 40, evenly among the tracked points."""
        tracked = np.flatnonzero(
            np.isfinite(self.positions_m).all(axis=1) & np.isfinite(covariances_m2).all(axis=(1, 2))
        )
        if not tracked.size:
            return
        self._chosen = tracked[:: int(np.ceil(len(tracked) / _MOST_ELLIPSOIDS))]
        rotations, self._semi_axes = ellipsoid_axes(covariances_m2[self._chosen])
        sphere = surface_of(trimesh.creation.icosphere(subdivisions=_SUBDIVISIONS))
        self.regions = self._scene.add_batched_meshes_simple(
            f"{self._name}/regions",
            sphere.vertices,
            sphere.faces,
            np.roll(Rotation.from_matrix(rotations).as_quat(), 1, axis=-1),
            self.positions_m[self._chosen],
            batched_scales=self._semi_axes,
            batched_colors=self._colour,
            opacity=0.18,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )


def linear_intensities(colours: ByteArray) -> ByteArray:
    """Convert sRGB colours to the linear intensities that the page expects for vertices."""
    share = colours / 255.0
    intensity = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.rint(255.0 * intensity).astype(np.uint8)


def track_segments(positions_m: FloatArray, first: int, last: int) -> NDArray[np.intp]:
    """Return the ends (k, 2) of at most 500 segments between two points of a track (n, 3).

    No segment crosses a point that is not finite.
    """
    chosen = np.unique(np.linspace(first, last, min(last - first, _MOST_SEGMENTS) + 1).round().astype(np.intp))
    missing = np.cumsum(~np.isfinite(positions_m).all(axis=1))
    ends = np.stack([chosen[:-1], chosen[1:]], axis=1)
    known = np.isfinite(positions_m[ends]).all(axis=(1, 2)) & (missing[ends[:, 0]] == missing[ends[:, 1]])
    return ends[known]
