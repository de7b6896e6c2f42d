"""Variable projection: the moment is linear and eliminated, so that a fit of one source is a search over its position.

The readable reference of :mod:`magloc.localization.fit.refinement`, for models of one row: its oracle.
"""

from __future__ import annotations

import numpy as np

from arrays.typing import FloatArray
from magloc.localization.fit.refinement import Refinements, refine_starts
from magloc.measurement.whitened import WhitenedModel


def unit_basis(model: WhitenedModel, q: FloatArray) -> FloatArray:
    """Whitened readings (..., C, 3) of the three unit scaled moments at q (..., 4)."""
    flat = q.reshape(-1, 1, 4)
    gain = np.broadcast_to(model.gain, (len(flat), *model.gain.shape[1:]))
    return model.moment_jacobian(flat, gain).reshape(*q.shape[:-1], -1, 3)


def projected_chi2(model: WhitenedModel, q: FloatArray, y: FloatArray) -> FloatArray:
    """χ² (...) of whitened readings y (..., C) with the best moment at q (..., 4)."""
    orthonormal = np.linalg.qr(unit_basis(model, q)).Q
    residual: FloatArray = y - np.einsum("...cj,...c,...dj->...d", orthonormal, y, orthonormal)
    chi2: FloatArray = np.einsum("...c,...c->...", residual, residual)
    return chi2


def best_moment(model: WhitenedModel, q: FloatArray, y: FloatArray) -> FloatArray:
    """Scaled moment (3,) that fits whitened readings y (C,) best at q (4,)."""
    mu: FloatArray = np.asarray(np.linalg.lstsq(unit_basis(model, q), y, rcond=None)[0], dtype=np.float64)
    return mu


def refined(model: WhitenedModel, y: FloatArray, q: FloatArray, max_iterations: int = 100) -> Refinements:
    """Refinements of one source from a start (b, 4) for each row of whitened readings (b, C), by the kernel."""
    ends = refine_starts(model, y, q[:, None], max_iterations=max_iterations)
    return ends._replace(q=ends.q[:, 0], mu=ends.mu[:, 0])
