"""Track of a body as a result, the motion that a tracker assumes, and the rows that it follows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from arrays.io.csv import Column
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.bodies.body import MagnetBody
from magloc.bodies.fit import linearise
from magloc.bodies.poses import BodyPoses
from magloc.chi_square import exceeds
from magloc.levels import MISFIT
from magloc.measurement.rows import WhitenedRows
from magloc.measurement.whitened import WhitenedModel
from magloc.state_space import ornstein_uhlenbeck_step

_LARGEST_TURN_RAD = 0.5  # of a prediction; beyond it one Gaussian does not describe the pose
_LARGEST_WAY = 0.3  # the same of a translation, in radii of the array


@dataclass(frozen=True)
class BodyMotion:
    """Motion of a body: velocity and rotation rate with a typical size and a correlation time.

    Attributes
    ----------
    speed_m_s, turn_rad_s : float
        Standard deviations of velocity and rotation rate, along and about each axis.
    correlation_s : float
        Correlation time of both.
    """

    speed_m_s: float = 0.1
    turn_rad_s: float = 2.0
    correlation_s: float = 0.2

    def step(self, dt_s: float, radius_m: float) -> list[float]:
        """Return ten numbers of a step for the kernel, with lengths in radii."""
        lasts_s, left, root = ornstein_uhlenbeck_step(self.correlation_s, dt_s)
        parts = root[[0, 1, 1], [0, 0, 1]]
        return [
            *(lasts_s, left, *(self.speed_m_s / radius_m * parts)),
            *(lasts_s, left, *(self.turn_rad_s * parts)),
        ]

    def is_lost(self, dt_s: FloatArray, radius_m: float) -> BoolArray:
        """Return whether predictions over gaps (n,) are too uncertain for one Gaussian."""
        far: BoolArray = self.speed_m_s * dt_s > _LARGEST_WAY * radius_m
        return (self.turn_rad_s * dt_s > _LARGEST_TURN_RAD) | far


@dataclass(frozen=True, eq=False)
class BodyTrack(BodyPoses):
    """Poses of a body through time, one of each row.

    Attributes
    ----------
    nis : ndarray, shape (n,)
        Normalised innovation squared; `chi2` is the same.
    status : list of str
        "tracked", or why the row is not.
    velocity_m_s, rate_rad_s : ndarray, shape (n, 3)
        Velocity in the array's frame, rotation rate in the body's.
    """

    status: list[str] = None  # type: ignore[assignment]
    velocity_m_s: FloatArray = None  # type: ignore[assignment]
    rate_rad_s: FloatArray = None  # type: ignore[assignment]

    command = "magloc track --body"

    @classmethod
    def none(cls, n: int, width: int = 1, symmetry: str = "") -> BodyTrack:
        """Return n rows without a pose."""
        poses, (velocity, rate) = BodyPoses.none(n, width, symmetry), np.full((2, n, 3), np.nan)
        return cls(**vars(poses), status=[""] * n, velocity_m_s=velocity, rate_rad_s=rate)

    @property
    def nis(self) -> FloatArray:
        """Normalised innovation squared of each row (n,)."""
        return self.chi2[:, 0]

    def columns(self) -> dict[str, Column]:
        """Return the columns of the CSV file."""
        of_rates = {f"v{axis}_m_s": self.velocity_m_s[:, i] for i, axis in enumerate("xyz")}
        of_rates |= {f"rate_{axis}_deg_s": np.degrees(self.rate_rad_s[:, i]) for i, axis in enumerate("xyz")}
        return super().columns() | of_rates | {"status": self.status}

    def entries(self) -> Iterator[dict[str, object]]:
        """Return the results that ``magloc track --body --json`` prints."""
        for i, entry in enumerate(super().entries()):
            yield entry | {"status": self.status[i]}


_RECENT = 50  # rows of a track over which its NIS is judged


@dataclass(frozen=True, eq=False)
class TrackRows:
    """Whitened rows of any missing channels, for the kernel."""

    model: WhitenedModel
    y: FloatArray
    n_differences: IntArray
    effects: FloatArray  # (n, a, C)


def joined_rows(groups: list[WhitenedRows], n: int, effects: list[FloatArray]) -> TrackRows:
    """Return rows of several groups in their order; common fields of fewer columns are filled up with zeros."""
    width = max(group.model.basis.shape[2] for group in groups)
    first = groups[0].model
    n_channels, n_errors = groups[0].y.shape[1], effects[0].shape[1]
    gain, y = np.zeros((n, n_channels, 3)), np.zeros((n, n_channels))
    basis, shrinkage = np.zeros((n, n_channels, width)), np.zeros((n, width))
    ambient, n_differences = np.zeros((n, *first.ambient.shape[1:])), np.zeros(n, dtype=np.intp)
    of_errors = np.zeros((n, n_errors, n_channels))
    for group, effect in zip(groups, effects, strict=True):
        at, q = group.index, group.model.basis.shape[2]
        gain[at], y[at], ambient[at] = group.model.gain, group.y, group.model.ambient
        basis[at, :, :q], shrinkage[at, :q] = group.model.basis, group.model.shrinkage
        n_differences[at], of_errors[at] = group.n_differences, effect
    model = replace(first, gain=gain, ambient=ambient, basis=basis, shrinkage=shrinkage)
    return TrackRows(model, y, n_differences, of_errors)


def nearest_poses(poses: BodyPoses, position_m: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a pose for each row after a pose: of several the nearest to the one before, of none that one.

    The results (n + 1, 3) and (n + 1, 3, 3) begin with the given pose.
    """
    places, turns = [position_m], [R]
    for i, n_poses in enumerate(poses.n_poses.tolist()):
        apart = np.linalg.norm(poses.R[i, : max(n_poses, 1)] - turns[-1], axis=(-2, -1))
        k = int(np.argmin(apart))
        places.append(poses.position_m[i, k] if n_poses else places[-1])
        turns.append(poses.R[i, k] if n_poses else turns[-1])
    return np.array(places), np.array(turns)


def placement_effects(
    body: MagnetBody, n: int, group: WhitenedRows, position_m: FloatArray, R: FloatArray
) -> FloatArray:
    """Return the whitened readings (b, n, C) of the last n stated errors of the magnets, at poses of all rows.

    They are zero without a pose.
    """
    *_, errors = linearise(group.model, body, position_m[group.index], R[group.index])
    of_places = group.model.whiten(np.nan_to_num(errors[..., errors.shape[-1] - n :]))
    return np.ascontiguousarray(of_places.transpose(0, 2, 1))


def flag_misfits(track: BodyTrack, recent: FloatArray) -> FloatArray:
    """Flag the rows of a track whose NIS, with that of rows before, is far beyond noise; return the last ones.

    `recent` (m, 2) has NIS and degrees of freedom of the rows before. The covariance of these rows is enlarged.
    """
    used = np.flatnonzero(track.solved & (track.dof > 0))
    all_rows = np.concatenate([recent, np.column_stack([track.nis[used], track.dof[used]])])
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(all_rows, axis=0)])
    end = len(recent) + 1 + np.arange(used.size)
    nis, dof = (sums[end] - sums[np.maximum(end - _RECENT, 0)]).T
    over = exceeds(nis, dof.astype(np.intp), MISFIT)
    for i, factor in zip(used[over].tolist(), (nis[over] / dof[over]).tolist(), strict=True):
        track.flags[i] = (*track.flags[i], "misfit")
        track.covariance[i] *= factor
    return all_rows[-_RECENT:]
