"""Fixed-interval smoother of a track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from arrays.typing import FloatArray
from magloc.state_space import predict, smoothing_gain
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import Prediction, Step, TrackPoint


def smooth_points(points: list[TrackPoint], steps: list[Step]) -> list[TrackPoint]:
    """Return the smoothed points of a record: a fixed-interval smoother over every track.

    It is the Rauch-Tung-Striebel recursion on the filter's steps, in square roots.
    """
    result = list(points)
    for step, (x, S) in zip(steps, smooth_states(steps), strict=True):
        point = points[step.row]
        if point.position_m is not None:
            assert point.centroid_m is not None
            source = Mixture.of_gaussian(x[:N_SOURCE], S[:N_SOURCE], point.centroid_m, point.radius_m)
            mean, covariance = source.moments()
            result[step.row] = replace(
                point, position_m=mean[:3], moment_Am2=mean[3:], covariance=covariance, mixture=source
            )
    return result


def smooth_states(steps: Sequence[Step]) -> list[tuple[FloatArray, FloatArray]]:
    """Return the smoothed state of every step, and the root of its covariance."""
    found: list[tuple[FloatArray, FloatArray]] = []
    later: Prediction | None = None
    for step in reversed(steps):
        x, S = step.x, step.S
        if later is not None:
            G, D = smoothing_gain(S, later.F, later.S_q)
            x, S = x + G @ (found[-1][0] - later.x), predict(found[-1][1], G, D)
        found.append((x, S))
        later = step.prediction
    return found[::-1]
