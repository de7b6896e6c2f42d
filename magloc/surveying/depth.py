"""Depth of a weak target: an interval from the profile of χ², which is not a parabola."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from magloc.surveying.joint_fit import Background, JointFit, jacobian_of, with_free_sources
from magloc.surveying.rounds import Model
from magloc.surveying.search import WINDOW, normal_equations

_N_DEPTHS = 24
_SPAN = 3.0  # over and under the depth, as a factor
_STEPS = 5  # of places on each side, in thirds of a standard deviation of the position


def depth_interval(
    model: Model, fit: JointFit, background: Background, which: int, ground_m: float
) -> tuple[float, float]:
    """95 % interval of the depth of a source, place and moment free, the others linear."""
    record, white = model.record, background.white
    source = fit.sources.some(np.array([which]))
    others = fit.sources.some(np.delete(np.arange(len(fit.sources)), which))
    position = source.position_m[0]
    height = record.height_m - position[2]
    middles = record.sensors_m.mean(axis=1)[white.starts[:-1], :2]
    used = np.flatnonzero(np.all(np.abs(middles - position[:2]) < WINDOW * height, axis=1))
    near = np.linalg.norm(others.position_m[:, :2] - position[:2], axis=1) < 2.0 * WINDOW * height
    Q = with_free_sources(record, background, others.some(near))
    # What the source explains itself is put back, to first order: it is weak.
    own_field = record.fields(source.position_m, source.moment_Am2)
    own = jacobian_of(record, background, source, own_field)[:, 3:] @ source.moment_Am2[0]
    left = fit.residual + own
    left = left - Q @ (Q.T @ left)
    directions = record.directions(record.fields(fit.sources.position_m, fit.sources.moment_Am2))
    depth = ground_m - position[2]
    lowest = ground_m - model.bounds.high_m[2]
    depths = np.geomspace(max(lowest, depth / _SPAN), min(ground_m - model.bounds.low_m[2], depth * _SPAN), _N_DEPTHS)
    sigma = np.sqrt(np.diagonal(fit.covariance)[6 * which : 6 * which + 2])
    offset = np.linspace(-1.5, 1.5, _STEPS)
    x, y = position[0] + sigma[0] * offset, position[1] + sigma[1] * offset
    explained = np.empty(_N_DEPTHS)
    for i, at in enumerate(depths):
        places = np.stack(np.meshgrid(x, y, [ground_m - at], indexing="ij"), axis=-1).reshape(-1, 3)
        _, projected, v = normal_equations(record, white, directions, places, used, Q, left)
        explained[i] = np.sum(v * np.linalg.solve(projected, v[..., None])[..., 0], axis=1).max()
    inside = np.flatnonzero(explained > explained.max() - chdtri(1, 0.05))
    low, high = max(inside[0] - 1, 0), min(inside[-1] + 1, _N_DEPTHS - 1)
    return float(depths[low]), float(depths[high])
