r"""Division of mixture components over which a row's readings are nonlinear.

An update by readings that are linear over a Gaussian leaves it Gaussian. With the Jacobian J of the readings in units
of their noise and the root S of position and moment, the right singular vectors of J S are independent axes of the
source. One standard deviation v of the whole state along an axis changes the predicted readings by an odd part
:math:`g = \tfrac12 (h(v) - h(-v))` and an even part :math:`c = \tfrac12 (h(v) + h(-v)) - h(0)`. A linearisation
neglects the even part, of which :math:`c / (1 + |g|^2)` remains within the posterior of the axis, in every row alike.
Over the :math:`1/|g|^2` rows that determine the axis, but at most the n rows that the component has used, this sums to

.. math:: \beta = \frac{|c|}{1 + |g|^2} \sqrt{\min(\max(|g|^{-2}, 1), n)}

standard deviations of the readings' noise. A component with :math:`\beta > \tfrac12` becomes three along that axis,
which have the same mean and covariance together. The nonlinear prediction of :func:`magloc.tracking.row_filter.update`
treats smaller nonlinearities. A division only approximates a Gaussian, so that needless ones lose accuracy.

Principal axes of log-range and direction are not enough. If direction and moment are nearly parallel, two sources of
one gradient tensor are close, and the readings fold along an axis on which moment and direction turn together.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.tracking import row_filter
from magloc.tracking.chart.mixture import Mixture, root_of
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.row_filter import LARGEST_BEND, Gaussians

MOST_COMPONENTS = 80
"""Largest number of components after a division."""
MOST_ROWS = 400
"""Largest number of rows over which the nonlinearity is counted."""
# Weights and standard deviation of three normal densities that approximate one (DeMars and others, 2013). The means
# keep its variance.
_WEIGHTS, _SIGMA = np.array([0.2252246, 0.5495508, 0.2252246]), 0.6715662
_MEANS = np.sqrt((1.0 - _SIGMA**2) / (2.0 * _WEIGHTS[0])) * np.array([-1.0, 0.0, 1.0])
# Logarithm of a weight over the largest one below which a component is not divided.
_LIGHT = -7.0
_MOST_ROUNDS = 4


def split(mixture: Mixture, row: RowMeasurement) -> tuple[Mixture, IntArray]:
    """Divide the components of a prediction over which a row's readings are nonlinear.

    Returns
    -------
    parts : Mixture
        The components, divided where needed.
    origin : ndarray of int
        Index of the component from which each part comes.
    """
    origin = np.arange(len(mixture))
    for _ in range(_MOST_ROUNDS):
        bend, directions = bends(mixture, row)
        worst = np.argmax(bend, axis=1)
        divided = (np.max(bend, axis=1) > LARGEST_BEND) & (mixture.log_weight > mixture.log_weight.max() + _LIGHT)
        index = np.flatnonzero(divided)
        index = index[np.argsort(-mixture.log_weight[index], kind="stable")]
        index = index[: max(0, (MOST_COMPONENTS - len(mixture)) // 2)]
        if not index.size:
            break
        mixture = _divide(mixture, index, directions[index, worst[index]])
        origin = np.concatenate([np.delete(origin, index), np.tile(origin[index], len(_WEIGHTS))])
    return mixture, origin


def bends(mixture: Mixture, row: RowMeasurement) -> tuple[FloatArray, FloatArray]:
    """Return the nonlinearity (K, 6) of a row's readings, and one σ (K, 6, N) along each axis."""
    gaussians, memory = Gaussians(mixture.x, mixture.S), min(mixture.n_rows, MOST_ROWS)
    bend, directions = row_filter.bends(gaussians, row.kernel_rows, memory)
    # A wide component may overflow.
    return np.where(np.isfinite(bend), bend, 0.0), directions


def _divide(mixture: Mixture, index: IntArray, v: FloatArray) -> Mixture:
    """Replace some components by three each along axes v (k, N) of length one σ."""
    n, S, others = mixture.n_charted, root_of(mixture.S[index]), np.delete(np.arange(len(mixture)), index)
    # In standardised coordinates v is a unit vector; with a lower root those of the source come first.
    axis = np.linalg.solve(S[:, :N_SOURCE, :N_SOURCE], v[:, :N_SOURCE, None])
    narrow = S.copy()
    narrow[:, :, :N_SOURCE] -= (1.0 - _SIGMA) * v[:, :, None] * np.swapaxes(axis, 1, 2)
    chart = mixture.chart.take(index).with_firm_moments(S[:, :n])
    x, roots, log_weight = [mixture.x[others]], [mixture.S[others]], [mixture.log_weight[others]]
    for weight, mean in zip(_WEIGHTS, _MEANS, strict=True):
        state, root = mixture.x[index] + mean * v, narrow.copy()
        state[:, :n], L = chart.linearise(mean * v[:, :n])
        root[:, :n] = replace(mixture, x=state).chart.inverse_jacobian() @ L @ root[:, :n]
        x.append(state)
        roots.append(root_of(root))
        log_weight.append(mixture.log_weight[index] + np.log(weight))
    return replace(mixture, x=np.concatenate(x), S=np.concatenate(roots), log_weight=np.concatenate(log_weight))
