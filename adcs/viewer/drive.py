"""Data of a replay: a drive on the table, its estimate, its late fixes, and their camera frames."""

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

SETTLING_S = 10.0
"""End of the first transient, which the scales of the plots ignore."""


@dataclass(frozen=True, eq=False)
class IdentifiedFrame:
    """Frame of the camera with its identified stars.

    Attributes
    ----------
    image : ndarray of uint8, shape (height, width)
    stars_px : ndarray, shape (f, 2)
        Column and row of all stars that were found.
    fix : CameraFix or NoFix
    """

    image: ByteArray
    stars_px: FloatArray
    fix: CameraFix | NoFix


@dataclass(frozen=True, eq=False)
class Drive:
    """Drive with its estimate.

    Attributes
    ----------
    title : str
    lights_m : ndarray, shape (n, 2)
        Lights of the sky [m].
    camera : Camera
    truth, track : PlanarTrack
        True and estimated track at the same instants, from 0 s on.
    fixes : FixRecord
        Fixes in the order of their arrival.
    exposure_s : ndarray, shape (k,)
        True times of their images [s].
    outcomes : tuple of FixOutcome
    sigma_m : ndarray, shape (n, 2), optional
        Standard deviations of X and Y by the method [m].
    frame_of : callable
        It computes the frame of a fix by its number; the player calls it for visible frames only.
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
    frame_of: Callable[[int], IdentifiedFrame]

    @cached_property
    def errors_m(self) -> FloatArray:
        """Estimate minus truth, shape (n, 2)."""
        return self.track.position_m - self.truth.position_m

    @property
    def duration_s(self) -> float:
        """Duration of the drive [s]."""
        return float(self.truth.time_s[-1])

    @cached_property
    def usual_error_m(self) -> float:
        """95 % quantile of the distance between estimate and truth, without the first transient [m]."""
        late = self.truth.time_s >= min(SETTLING_S, 0.5 * self.duration_s)
        return float(np.percentile(np.linalg.norm(self.errors_m[late], axis=1), 95.0))

    def row_at(self, time_s: float) -> int:
        """Return the number of the last instant up to a time, or of the first instant."""
        return max(0, int(np.searchsorted(self.truth.time_s, time_s + 1e-9, side="right")) - 1)

    def last_fix(self, row: int) -> int | None:
        """Return the number of the latest fix, if there is one yet."""
        arrived = int(np.searchsorted(self.fixes.arrival_s, self.truth.time_s[row], side="right"))
        return arrived - 1 if arrived else None

    def true_pose(self, row: int) -> Pose:
        """Return the true pose of the satellite."""
        return _planar_pose(self.truth.state(row))

    def pose_of_exposure(self, fix: int) -> Pose:
        """Return the true pose at the exposure of a fix."""
        return _planar_pose(self.truth.at(self.exposure_s[fix : fix + 1]).state(0))


def _planar_pose(state: PlanarState) -> Pose:
    x, y = state.position_m.tolist()
    return Pose(x, y, float(state.heading_rad))
