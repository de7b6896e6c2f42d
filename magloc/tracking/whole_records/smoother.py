"""Fixed-interval smoother of a track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from arrays.typing import FloatArray
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import Step, TrackPoint


def smooth_points(points: list[TrackPoint], steps: list[Step]) -> list[TrackPoint]:
    """Return the smoothed points of a record: a fixed-interval smoother over every track.

    It is the Rauch-Tung-Striebel recursion on the filter's steps, with the gain :math:`P F^T P_{pred}^{-1}`.
    """
    result = list(points)
    for step, (x, P) in zip(steps, smooth_states(steps), strict=True):
        point = points[step.row]
        if point.position_m is not None:
            assert point.centroid_m is not None
            source = Mixture.of_gaussian(x[:N_SOURCE], P[:N_SOURCE, :N_SOURCE], point.centroid_m, point.radius_m)
            mean, covariance = source.moments()
            result[step.row] = replace(
                point, position_m=mean[:3], moment_Am2=mean[3:], covariance=covariance, mixture=source
            )
    return result


def smooth_states(steps: list[Step]) -> list[tuple[FloatArray, FloatArray]]:
    """Return the smoothed state and covariance of every step."""
    result: list[tuple[FloatArray, FloatArray]] = []
    x, P = np.empty(0), np.empty((0, 0))
    after: Step | None = None
    for step in reversed(steps):
        later_x, later_P = x, P
        x, P = step.x, step.S @ step.S.T
        if after is not None and after.prediction is not None:
            predicted = after.prediction
            predicted_P = predicted.S @ predicted.S.T
            # States of mixed units: solve with the correlations.
            scale = np.sqrt(np.diagonal(predicted_P))
            correlation = predicted_P / np.outer(scale, scale)
            gain = np.linalg.solve(correlation, (predicted.F @ P) / scale[:, None]).T / scale
            x = x + gain @ (later_x - predicted.x)
            P = P + gain @ (later_P - predicted_P) @ gain.T
            P = 0.5 * (P + P.T)
        after = step
        result.append((x, P))
    return result[::-1]
