"""Magnets of a body as tracks of the viewer, so that the body turns with its poses."""

from __future__ import annotations

from magloc.bodies.body import MagnetBody
from magloc.bodies.poses import BodyPoses
from magloc.live.body import magnet_points
from magloc.tracking.results import TrackResult


def magnet_tracks(body: MagnetBody, poses: BodyPoses) -> TrackResult:
    """Return the tracks of a body's magnets, one for each magnet in their order, in the rows that have a pose.

    Raises
    ------
    ValueError
        No row has a pose.
    """
    points = magnet_points(body, poses)
    if not points:
        raise ValueError("Input result must have a row with a pose; instead received none.")
    first, *others = zip(*points.values(), strict=True)
    return TrackResult(first, False, tuple(range(1, len(others) + 2)), tuple(others), kind="magnet")
