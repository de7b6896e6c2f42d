"""Pose of a body of several magnets, with its magnets as sources."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from magloc.bodies.body import MagnetBody
from magloc.bodies.field import placed_magnets
from magloc.bodies.filter import BodyTracker
from magloc.bodies.poses import BodyPoses
from magloc.bodies.track import BodyTrack
from magloc.navigation.rotations import cross_matrix
from magloc.tracking.results import SourcePoint, SourcesPoint
from magloc.tracking.rows import Row


@dataclass(frozen=True, eq=False)
class BodyPoint(SourcesPoint):
    """Pose of a body at one instant; its magnets are the tracks.

    Attributes
    ----------
    time_s, tracks, status, chi2, dof, dropped_sensors
        See :class:`SourcesPoint`.
    body : MagnetBody
    poses : BodyTrack of length one
        Pose, covariance, flags and rates.
    """

    body: MagnetBody = field(kw_only=True)
    poses: BodyTrack = field(kw_only=True)


def body_points(body: MagnetBody, track: BodyTrack) -> list[BodyPoint]:
    """Return the rows of a track as points."""
    magnets = magnet_points(body, track)
    values = zip(track.time_s.tolist(), track.status, track.nis.tolist(), track.dof.tolist(), strict=True)
    return [
        BodyPoint(time_s, magnets.get(i, ()), status, chi2, dof, body=body, poses=track[i : i + 1])
        for i, (time_s, status, chi2, dof) in enumerate(values)
    ]


def advance(tracker: BodyTracker, rows: Sequence[Row]) -> list[BodyPoint]:
    """Update the tracker with rows in their order, and return their points."""
    ambient = [row.ambient_T for row in rows if row.ambient_T is not None]
    values, times = (np.array([getattr(row, name) for row in rows]) for name in ("readings_T", "time_s"))
    return body_points(tracker.body, tracker.follow(values, times, np.array(ambient) if ambient else None))


def without_pose(body: MagnetBody, rows: Sequence[Row], status: str) -> list[BodyPoint]:
    """Return points that have only a status."""
    track = BodyTrack.none(len(rows))
    track = replace(track, time_s=np.array([row.time_s for row in rows]), status=[status] * len(rows))
    return body_points(body, replace(track, reason=track.status))


def magnet_points(body: MagnetBody, poses: BodyPoses) -> dict[int, tuple[SourcePoint, ...]]:
    """Return the magnets as sources by the rows that have a pose; ids are 1, 2, … in the order of the body.

    The covariance of a magnet follows from the pose, without the errors of the body's own geometry and moments.
    """
    rows = np.flatnonzero(poses.solved)
    R = poses.R[rows, 0]
    places, moments = placed_magnets(body, poses.position_m[rows, 0], R)
    by_pose = np.zeros((len(rows), len(body.magnets), 6, 6))
    by_pose[..., :3, :3] = np.eye(3)
    for part, own in ((slice(3), body.positions_m), (slice(3, 6), body.moments_Am2)):
        by_pose[..., part, 3:] = -R[:, None] @ cross_matrix(own)
    covariances = by_pose @ poses.covariance[rows, 0][:, None] @ np.swapaxes(by_pose, -1, -2)
    return {
        row: tuple(
            SourcePoint(float(poses.time_s[row]), place, moment, covariance, status="tracked", id=id)
            for id, (place, moment, covariance) in enumerate(zip(*of_row, strict=True), start=1)
        )
        for row, *of_row in zip(rows.tolist(), places, moments, covariances, strict=True)
    }
