"""A finished track with what later rows tell as well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from arrays.typing import FloatArray
from magloc.tracking.chart.coordinates import Chart
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import Step, TrackPoint

# Of correlations: see :func:`_root`.
_LEAST_VARIANCE = 1e-12


def smoothed(points: list[TrackPoint], steps: list[Step]) -> list[TrackPoint]:
    """Points of a finished record with what later rows tell as well: a fixed-interval smoother over every track.

    Rauch, Tung and Striebel's recursion in the charts about the filter's states and predictions.
    """
    result = list(points)
    later: Step | None = None
    x, P = np.empty(0), np.empty((0, 0))
    for step in reversed(steps):
        x, P = _with_later(step, later, x, P)
        later = step
        point, known = points[step.row], step.known
        if point.position_m is not None:
            S = _root(P[:N_SOURCE, :N_SOURCE])
            source = replace(known, x=x[None, :N_SOURCE], S=S[None], n_motion=N_SOURCE, n_pose=0)
            mean, covariance = source.moments()
            result[step.row] = replace(
                point, position_m=mean[:3], moment_Am2=mean[3:], covariance=covariance, mixture=source
            )
    return result


def _with_later(
    step: Step, later: Step | None, x_later: FloatArray, P_later: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """State and covariance, in the chart about it, at a step, from those at the next one of the same track."""
    known = step.known
    P = known.S[0] @ known.S[0].T
    if later is None or later.prediction is None or later.transition is None:
        return known.x[0], P
    prediction, n = later.prediction, known.n_motion
    predicted_P = prediction.S[0] @ prediction.S[0].T
    offset = x_later - prediction.x[0]
    about = prediction.chart
    offset[:n] = about.coordinates(x_later[None, :n])[0]
    P_there = _turned(P_later, _chart_about(x_later, prediction), np.zeros(n), about, offset[:n])
    gain = smoother_gain(P, later.transition, predicted_P)
    e = gain @ offset
    P = P + gain @ (P_there - predicted_P) @ gain.T
    x = known.x[0] + e
    x[:n] = known.chart.retracted(e[None, :n])[0]
    return x, _turned(0.5 * (P + P.T), known.chart, e[:n], _chart_about(x, known), np.zeros(n))


def _root(P: FloatArray) -> FloatArray:
    """Root of a covariance that rounding, and what two charts differ by, may have left a little less than positive."""
    scale = np.sqrt(np.maximum(np.diagonal(P), 1e-300))
    variance, axes = np.linalg.eigh(P / np.outer(scale, scale))
    return np.asarray(scale[:, None] * axes * np.sqrt(np.maximum(variance, _LEAST_VARIANCE)))


def _chart_about(x: FloatArray, like: Mixture) -> Chart:
    return Chart.at(x[None, : like.n_motion], like.centroid_m, like.radius_m, like.n_pose)


def _turned(P: FloatArray, old: Chart, e_old: FloatArray, new: Chart, e_new: FloatArray) -> FloatArray:
    """A covariance (N, N) in another chart, where a state has the coordinates e_old in one and e_new in the other."""
    n = e_old.size
    turn = np.linalg.solve(new.jacobian(e_new[None])[0], old.jacobian(e_old[None])[0])
    turned = P.copy()
    turned[:n] = turn @ turned[:n]
    turned[:, :n] = turned[:, :n] @ turn.T
    return turned


def smoother_gain(P: FloatArray, F: FloatArray, predicted_P: FloatArray) -> FloatArray:
    r""":math:`P F^T P_{pred}^{-1}`, solved with the correlations: states are of mixed units."""
    scale = np.sqrt(np.diagonal(predicted_P))
    correlation = predicted_P / np.outer(scale, scale)
    return np.asarray(np.linalg.solve(correlation, (F @ P) / scale[:, None]).T / scale)
