"""Magnets of a body as tracks of the viewer, so that the body turns with its poses."""

from __future__ import annotations

from magloc.bodies.body import MagnetBody
from magloc.bodies.field import placed_magnets
from magloc.bodies.poses import BodyPoses
from magloc.tracking.results import TrackPoint, TrackResult


def magnet_tracks(body: MagnetBody, poses: BodyPoses) -> TrackResult:
    """Return the tracks of a body's magnets, one a magnet in their order, in the rows that have a pose.

    Raises
    ------
    ValueError
        No row has a pose.
    """
    rows = poses.solved
    if not rows.any():
        raise ValueError("Input result must have a row with a pose; instead received none.")
    places, moments = placed_magnets(body, poses.position_m[rows, 0], poses.R[rows, 0])
    times = poses.time_s[rows].tolist()
    tracks = [
        tuple(TrackPoint(*point, status="tracked") for point in zip(times, *one, strict=True))
        for one in zip(places.swapaxes(0, 1), moments.swapaxes(0, 1), strict=True)
    ]
    return TrackResult(tracks[0], False, tuple(range(1, len(tracks) + 1)), tuple(tracks[1:]), kind="magnet")
