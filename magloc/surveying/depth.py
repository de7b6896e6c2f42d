"""Depth of a weak target: an interval from the profile of χ², which is not a parabola."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from arrays.typing import FloatArray
from magloc.surveying.joint_fit import Background, JointFit, jacobian_of, orthogonal
from magloc.surveying.rounds import Model
from magloc.surveying.whitening_compiled import moment_columns, whiten

_UNKNOWN = 1e4
_N_DEPTHS = 24
_SPAN = 3.0  # over and under the depth, as a factor
_WINDOW = 5.0  # of rows that count, in distances from the sensors
_STEPS = 5  # of places on each side, in thirds of a standard deviation of the position


def depth_interval(
    model: Model, fit: JointFit, background: Background, which: int, ground_m: float
) -> tuple[float, float]:
    """95 % interval of the depth of a source, place and moment free, the others linear."""
    record, white = model.record, background.white
    source = fit.sources.some(np.array([which]))
    others = fit.sources.some(np.delete(np.arange(len(fit.sources)), which))
    position = source.position_m[0]
    height = float(np.median(record.sensors_m[..., 2].min(axis=1))) - position[2]
    middles = record.sensors_m.mean(axis=1)[white.starts[:-1], :2]
    used = np.flatnonzero(np.all(np.abs(middles - position[:2]) < _WINDOW * height, axis=1))
    k = len(white.U)
    of = (used[:, None] * k + np.arange(k)).ravel()
    Q = background.Q
    near = np.linalg.norm(others.position_m[:, :2] - position[:2], axis=1) < 2.0 * _WINDOW * height
    if near.any():
        J = jacobian_of(record, background, others.some(near))
        J = J - Q @ (Q.T @ J)
        Q = np.concatenate([Q, orthogonal(_UNKNOWN * J / np.linalg.norm(J, axis=0))], axis=1)
    # What the source explains itself is put back, to first order: it is weak.
    own = jacobian_of(record, background, source)[:, 3:] @ source.moment_Am2[0]
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
        A = moment_columns(
            record.sensors_m, directions, white.U, record.array.channel_sensor, places, white.starts, used
        )
        whiten(A, used, white.H, white.gains, white.kept, white.dt_s)
        explained[i] = _explained(A.reshape(-1, A.shape[-1]), Q[of], left[of]).max()
    inside = np.flatnonzero(explained > explained.max() - chdtri(1, 0.05))
    low, high = max(inside[0] - 1, 0), min(inside[-1] + 1, _N_DEPTHS - 1)
    return float(depths[low]), float(depths[high])


def _explained(A: FloatArray, Q: FloatArray, left: FloatArray) -> FloatArray:
    """χ² (m,) that sources of columns (r, 3 m) explain of what is left."""
    m = A.shape[1] // 3
    whole, lost = (X.reshape(-1, m, 3).transpose(1, 2, 0) for X in (A, Q.T @ A))
    v = (A.T @ left).reshape(m, 3)
    return np.asarray(np.sum(v * np.linalg.solve(whole @ whole.mT - lost @ lost.mT, v[..., None])[..., 0], axis=1))
