"""What a replay shows: a drive on the table, its estimate, its late fixes, and the frames they came from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from adcs.mockup.navigation.fixes import FixOutcome, FixRecord
from adcs.mockup.navigation.strapdown import PlanarState, PlanarTrack
from adcs.mockup.vision.camera import Camera, Pose
from adcs.mockup.vision.paper_matcher import CameraFix
from adcs.stars.identification import NoFix
from arrays.typing import ByteArray, FloatArray

SETTLED_S = 10.0
"""Scales are chosen for what comes after it."""


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """A frame of the camera and what was identified in it.

    Attributes
    ----------
    image : ndarray of uint8, shape (height, width)
    stars_px : ndarray, shape (f, 2)
        Column and row of the stars that were found.
    fix : CameraFix or NoFix
    """

    image: ByteArray
    stars_px: FloatArray
    fix: CameraFix | NoFix


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive and its estimate.

    Attributes
    ----------
    title : str
    lights_m : ndarray, shape (n, 2)
        The sky.
    camera : Camera
    truth, track : PlanarTrack
        At the same instants, from 0 s on.
    fixes : FixRecord
        Those that arrived, in that order.
    exposure_s : ndarray, shape (k,)
        When their images were truly taken.
    outcomes : tuple of FixOutcome
    sigma_m : ndarray, shape (n, 2), optional
        Standard deviations of X and Y that the method believes.
    frame_of : callable
        From the number of a fix to its frame; called when the frame is to be seen.
    """

    title: str
    lights_m: FloatArray
    camera: Camera
    truth: PlanarTrack
    track: PlanarTrack
    fixes: FixRecord
    exposure_s: FloatArray
    outcomes: tuple[FixOutcome, ...]
    sigma_m: FloatArray | None
    frame_of: Callable[[int], SeenFrame]

    @cached_property
    def errors_m(self) -> FloatArray:
        """Estimate minus truth, shape (n, 2)."""
        return self.track.position_m - self.truth.position_m

    @property
    def duration_s(self) -> float:
        """Of the drive."""
        return float(self.truth.time_s[-1])

    @cached_property
    def usual_error_m(self) -> float:
        """95 % of the distances between estimate and truth are below, the beginning left out."""
        late = self.truth.time_s >= min(SETTLED_S, 0.5 * self.duration_s)
        return float(np.percentile(np.linalg.norm(self.errors_m[late], axis=1), 95.0))

    def row_at(self, time_s: float) -> int:
        """Number of the last instant up to a time; the first one before it."""
        return max(0, int(np.searchsorted(self.truth.time_s, time_s + 1e-9, side="right")) - 1)

    def last_fix(self, row: int) -> int | None:
        """Number of the fix that arrived last, if one has."""
        arrived = int(np.searchsorted(self.fixes.arrival_s, self.truth.time_s[row], side="right"))
        return arrived - 1 if arrived else None

    def true_pose(self, row: int) -> Pose:
        """Where the satellite is."""
        return _pose(self.truth.state(row))

    def pose_of_exposure(self, fix: int) -> Pose:
        """Where it was when the image of a fix was taken."""
        return _pose(self.truth.at(self.exposure_s[fix : fix + 1]).state(0))


def _pose(state: PlanarState) -> Pose:
    x, y = state.position_m.tolist()
    return Pose(x, y, float(state.heading_rad))
