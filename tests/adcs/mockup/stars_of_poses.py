"""Stars of random poses, and how well a matcher does on them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from adcs.mockup.vision.camera import Camera, Pose, centred_from_table, distort, in_frame
from adcs.mockup.vision.paper_matcher import CameraFix
from adcs.mockup.vision.sky import led_sky
from adcs.mockup.vision.triangles import TriangleCatalogue
from adcs.stars.identification import NoFix
from sims.experiments.mockup_vision import FALSE_HEADING_RAD, FALSE_POSITION_M, REACH_M, SkySetup, sky_run

BORDER_PX = 5.0


@cache
def catalogue(seed: int = 0) -> TriangleCatalogue:
    return TriangleCatalogue.of(led_sky(seed).positions_m)


@dataclass(frozen=True)
class Field:
    """What the camera sees, as noise of centroids, lost lights and false ones."""

    footprint_m: float = 0.9
    noise_px: float = 0.1
    lost: float = 0.0
    spurious: int = 0

    @property
    def camera(self) -> Camera:
        return Camera(m_per_px=self.footprint_m / 640)


def projected(known, field, pose, rng):
    """Centred pixels of a pose, in random order, without the detour of an image."""
    camera = field.camera
    points = centred_from_table(camera, pose, known.positions_m)
    points = points[in_frame(camera, distort(camera, points), BORDER_PX)]
    points = points[rng.random(len(points)) >= field.lost]
    points = points + field.noise_px * rng.standard_normal(points.shape)
    half = [0.5 * camera.width_px - BORDER_PX, 0.5 * camera.height_px - BORDER_PX]
    return rng.permutation(np.concatenate([points, rng.uniform(-1.0, 1.0, (field.spurious, 2)) * half]))


def random_pose(rng):
    x, y, heading = rng.uniform(-1.0, 1.0, 3) * [*REACH_M, math.pi]
    return Pose(x, y, heading)


@cache
def projected_set(field, n, seed):
    """Poses and their stars."""
    rng = np.random.default_rng(seed)
    poses = [random_pose(rng) for _ in range(n)]
    return [(pose, projected(catalogue(), field, pose, rng)) for pose in poses]


class _Recorder:
    """A matcher that keeps what it is shown."""

    def __init__(self):
        self.points = []

    def identify(self, points_px):
        self.points.append(points_px)
        return NoFix("only looked at")


@cache
def rendered_set(setup: SkySetup, seed=0):
    """Poses and the stars that were found in rendered frames."""
    recorder = _Recorder()
    truth = sky_run(led_sky(0), recorder, setup, [seed]).truth
    return [(Pose(*row), points) for row, points in zip(truth, recorder.points, strict=True)]


@dataclass(frozen=True)
class Score:
    """Good fixes of all frames, false ones (farther than 20 mm, or 2°), and the errors of the good ones."""

    success: float
    false: int
    position_rms_m: float
    heading_rms_rad: float


def is_good(fix, pose):
    far = math.hypot(*(fix.position_m - pose.position_m)) > FALSE_POSITION_M
    return not far and abs(heading_error(fix, pose)) <= FALSE_HEADING_RAD


def heading_error(fix, pose):
    return math.remainder(fix.heading_rad - pose.heading_rad, 2.0 * math.pi)


def score(matcher, frames):
    fixes = [(matcher.identify(points), pose) for pose, points in frames]
    return score_of(fixes)


def score_of(fixes):
    found = [(fix, pose) for fix, pose in fixes if isinstance(fix, CameraFix)]
    good = [(fix, pose) for fix, pose in found if is_good(fix, pose)]
    squares = [[*((fix.position_m - pose.position_m) ** 2), heading_error(fix, pose) ** 2] for fix, pose in good]
    mean = np.mean(squares, axis=0) if squares else np.full(3, np.nan)
    return Score(len(good) / len(fixes), len(found) - len(good), math.sqrt(mean[0] + mean[1]), math.sqrt(mean[2]))


def random_points(n, count, seed):
    """Frames of points that are no lights."""
    rng = np.random.default_rng(seed)
    return [rng.uniform([-315.0, -235.0], [315.0, 235.0], (n, 2)) for _ in range(count)]
