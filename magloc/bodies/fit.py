"""Damped Gauss-Newton fits of a body's pose, many fits at once: the readable reference of ``body.hpp``.

The model is :class:`magloc.measurement.whitened.WhitenedModel` for b fits: channels of unit noise, without the common
field. Steps are (δx, δθ) of :mod:`magloc.bodies.field`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.bodies.body import MagnetBody
from magloc.bodies.field import body_fields, magnet_errors, magnet_fields, placed_magnets, pose_jacobian
from magloc.measurement.whitened import WhitenedModel
from magloc.navigation.rotations import rotation_matrix

LONGEST_TURN_RAD = 0.5
"""Longest rotation of one step."""
LONGEST_STEP = 0.5
"""Longest translation of one step, over the least distance of a magnet from a sensor."""
TOLERANCE, RELATIVE_TOLERANCE = 1e-8, 1e-12
"""Decrease of χ² that a step promises, absolute and relative to χ², below which a fit has converged."""
MAX_ITERATIONS = 60
IDLE_GAIN = 1e-7
"""Decrease of χ² by a step, over 1 + χ², below which a fit ends even if more is promised."""
_LARGEST_DAMPING, _IDLE_DAMPING = 1e9, 10.0


@dataclass(frozen=True, eq=False)
class PoseFits:
    """Fits of a pose, over any leading axes.

    Attributes
    ----------
    position_m : ndarray, shape (..., 3)
        Position of the body's origin in the array's frame [m].
    R : ndarray, shape (..., 3, 3)
        Rotation matrix from the body's frame to the array's.
    chi2 : ndarray, shape (...)
        χ² of the whitened residuals; infinite if a fit did not converge.
    iterations : ndarray of int, shape (...)
    """

    position_m: FloatArray
    R: FloatArray
    chi2: FloatArray
    iterations: IntArray

    @property
    def converged(self) -> BoolArray:
        """Fits that ended at an optimum."""
        return np.isfinite(self.chi2)

    def rows(self, index: IntArray | BoolArray) -> PoseFits:
        """Return some of the fits, by an index of the leading axes."""
        return PoseFits(*(values[index] for values in vars(self).values()))


def sensors_m(model: WhitenedModel) -> FloatArray:
    """Return the positions (N, 3) of a model's sensors in the array's frame [m]."""
    return np.asarray(model.centroid + model.radius * model.sensors)


def residuals(
    model: WhitenedModel, y: FloatArray, body: MagnetBody, position_m: FloatArray, R: FloatArray
) -> FloatArray:
    """Return the whitened residuals (b, C) of poses (b, …)."""
    return y - model.predict(body_fields(body, sensors_m(model), position_m, R))


def linearise(
    model: WhitenedModel, body: MagnetBody, position_m: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return predictions (b, C), their derivative (b, C, 6) by the pose, and errors of the magnets (b, C, q).

    The errors are in units of the noise, with the common field.
    """
    fields = magnet_fields(body, sensors_m(model), position_m, R)
    total_T = fields.field_T.sum(axis=-3)
    gain = model.linear_gain(total_T)

    def in_channels(columns: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("bca,bcaj->bcj", gain, columns[:, model.channel_sensor]))

    jacobian = model.whiten(in_channels(pose_jacobian(body, fields, R)))
    return model.predict(total_T), jacobian, in_channels(magnet_errors(body, fields, R))


def stepped(position_m: FloatArray, R: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return poses after steps (..., 6)."""
    return position_m + step[..., :3], R @ rotation_matrix(step[..., 3:])


def refine_poses(
    model: WhitenedModel,
    y: FloatArray,
    body: MagnetBody,
    position_m: FloatArray,
    R: FloatArray,
    *,
    max_iterations: int = MAX_ITERATIONS,
) -> PoseFits:
    """Return the optima that damped steps reach from starts, one for each of the model's b rows."""
    places = sensors_m(model)
    b = len(y)
    x, turn = position_m.copy(), R.copy()
    predicted, jacobian, _ = linearise(model, body, x, turn)
    residual = y - predicted
    chi2 = np.vecdot(residual, residual)
    damping, iterations = np.full(b, 1e-3), np.zeros(b, dtype=np.intp)
    state = np.zeros(b, dtype=np.intp)  # 0 running, 1 converged, 2 failed
    for _ in range(max_iterations):
        if not (state == 0).any():
            break
        step, promised, undamped = _steps(jacobian, residual, damping)
        done = undamped < TOLERANCE + RELATIVE_TOLERANCE * chi2
        state[(state == 0) & done] = 1
        state[(state == 0) & ~np.isfinite(chi2)] = 2
        step, promised = _shortened(step, promised, _distances(body, places, x, turn))
        trial_x, trial_turn = stepped(x, turn, step)
        trial, trial_jacobian, _ = linearise(model, body, trial_x, trial_turn)
        trial_residual = y - trial
        trial_chi2 = np.vecdot(trial_residual, trial_residual)
        gained = chi2 - trial_chi2
        running = state == 0
        taken = running & (gained > 0.0)
        worse = np.where(gained < 0.5 * promised, 3.0 * np.maximum(damping, 0.1), damping)
        better = np.where(gained > 0.75 * promised, 0.1 * damping, worse)
        damping = np.where(running, np.where(taken, better, 5.0 * np.maximum(damping, 1e-4)), damping)
        # Where the readings fold, what an undamped step promises never vanishes: steps that gain nothing end there.
        state[taken & (gained < IDLE_GAIN * (1.0 + chi2)) & (damping < _IDLE_DAMPING)] = 1
        state[running & (damping > _LARGEST_DAMPING)] = 2
        x[taken], turn[taken], chi2[taken] = trial_x[taken], trial_turn[taken], trial_chi2[taken]
        residual[taken], jacobian[taken] = trial_residual[taken], trial_jacobian[taken]
        iterations += running
    return PoseFits(x, turn, np.where(state == 1, chi2, np.inf), iterations)


def _steps(
    jacobian: FloatArray, residual: FloatArray, damping: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return damped steps (b, 6), the decrease of χ² that they promise, and that of undamped steps."""
    gradient = (jacobian.mT @ residual[..., None])[..., 0]
    information = jacobian.mT @ jacobian
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), np.finfo(np.float64).tiny))
    system = scale[:, :, None] * information * scale[:, None]
    one = np.eye(6)
    system = np.where(np.isfinite(system), system, one)
    scaled = np.where(np.isfinite(gradient), scale * gradient, 0.0)
    step = scale * np.linalg.solve(system + damping[:, None, None] * one, scaled[..., None])[..., 0]
    whole = scale * np.linalg.solve(system + 1e-12 * one, scaled[..., None])[..., 0]
    promised = np.vecdot(step, 2.0 * gradient - (information @ step[..., None])[..., 0])
    return step, promised, np.vecdot(gradient, whole)


def _distances(body: MagnetBody, places: FloatArray, x: FloatArray, R: FloatArray) -> FloatArray:
    """Return the least distance (b,) of a magnet from a sensor [m]."""
    magnets, _ = placed_magnets(body, x, R)
    return np.asarray(np.linalg.norm(magnets[:, :, None] - places, axis=-1).min(axis=(1, 2)))


def _shortened(step: FloatArray, promised: FloatArray, distance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return steps of bounded length, with the decrease of χ² that they promise, roughly."""
    longest = np.maximum(
        np.linalg.norm(step[:, 3:], axis=1) / LONGEST_TURN_RAD,
        np.linalg.norm(step[:, :3], axis=1) / (LONGEST_STEP * distance),
    )
    share = 1.0 / np.maximum(longest, 1.0)
    return share[:, None] * step, share * (2.0 - share) * promised
