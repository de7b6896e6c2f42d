"""The filter of a body in NumPy: reference of ``pose_track.hpp``, and the filter of magnets with shapes.

States are the pose (δx, δθ), errors of magnets and sensors, velocity and rotation rate. Positions are in radii of the
array, as in the kernel. Only the first states, all but the rates, act on the readings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from arrays.typing import FloatArray
from magloc.bodies.body import MagnetBody
from magloc.bodies.field import MagnetFields, magnet_fields, placed_magnets, pose_jacobian
from magloc.bodies.fit import sensors_m
from magloc.measurement.whitened import WhitenedModel
from magloc.navigation.rotations import cross_matrix

RATES = 6


@dataclass(frozen=True, eq=False)
class FilterState:
    """Position [radii], rotation matrix, errors (e,), rates (6,), and covariance (12 + e, 12 + e)."""

    x: FloatArray
    R: FloatArray
    errors: FloatArray
    rates: FloatArray
    covariance: FloatArray


def predicted_state(state: FilterState, steps: FloatArray, lasting: FloatArray, added: FloatArray) -> FilterState:
    """Return the state after a step, with the numbers of :meth:`magloc.bodies.filter.BodyMotion.step`."""
    (lasts_x, left_x, *_), (lasts_turn, left_turn, *_) = steps = steps.reshape(2, 5)
    n = len(state.covariance)
    turn = lasts_turn * state.rates[3:]
    F, Q = np.eye(n), np.zeros((n, n))
    F[:3, -6:-3], F[3:6, -3:] = lasts_x * np.eye(3), lasts_turn * np.eye(3)
    F[-6:-3, -6:-3], F[-3:, -3:] = left_x * np.eye(3), left_turn * np.eye(3)
    F[3:6, 3:6] = np.eye(3) - cross_matrix(turn)
    own = n - 12 - len(lasting) + 6 + np.arange(len(lasting))
    F[own, own], Q[own, own] = lasting, added**2
    for first, (*_, a, b, c) in zip((0, 3), steps, strict=True):
        for i in range(first, first + 3):
            rate = n - RATES + i
            Q[np.ix_([i, rate], [i, rate])] = [[a * a, a * b], [a * b, b * b + c * c]]
    errors = state.errors.copy()
    errors[len(errors) - len(lasting) :] *= lasting
    rates = state.rates * np.repeat([left_x, left_turn], 3)
    x, R = state.x + lasts_x * state.rates[:3], state.R @ Rotation.from_rotvec(turn).as_matrix()
    return FilterState(x, R, errors, rates, F @ state.covariance @ F.T + Q)


def updated_state(
    state: FilterState,
    model: WhitenedModel,
    y: FloatArray,
    body: MagnetBody,
    effects: FloatArray,
    *,
    curvature: float,
    max_iterations: int,
    tolerance: float,
) -> tuple[FilterState, float]:
    """Return the state after one row y (1, C) with effects (a, C) of the sensors' errors, and the NIS.

    A pose that is uncertain bends the readings by their size times the square of the uncertainty, relative to the
    distance. This counts as noise, times `curvature`.
    """
    d = len(state.covariance) - RATES
    P = state.covariance
    information = np.linalg.inv(P[:d, :d])
    error, x, R, errors = np.zeros(d), state.x, state.R, state.errors
    nis = np.inf
    places, _ = placed_magnets(body, x, R)
    sensors = (sensors_m(model) - model.centroid) / model.radius
    offset = (places - x) / model.radius + x
    nearest = 1.0 / np.linalg.norm(offset[:, None] - sensors, axis=-1).min()
    spread = 6.0 * nearest**2 * np.trace(P[:3, :3]) + 0.5 * np.trace(P[3:6, 3:6])
    weight = 1.0 / np.hypot(1.0, curvature * spread * np.sqrt(np.sum(y**2) / model.channels.struct.n_channels))
    for _ in range(max_iterations):
        residual, J = _linearised(model, y, body, effects, FilterState(x, R, errors, state.rates, P))
        residual, J = weight * residual, weight * J
        posterior = np.linalg.inv(information + J.T @ J)
        gradient = J.T @ residual - information @ error
        step = posterior @ gradient
        nis = float(residual @ residual + error @ information @ error - step @ gradient)
        x, R, errors = x + step[:3], R @ Rotation.from_rotvec(step[3:6]).as_matrix(), errors + step[6:]
        error = error + step
        error[3:6] = Rotation.from_matrix(state.R.T @ R).as_rotvec()
        if step @ gradient < tolerance:
            break
    gain = P[d:, :d] @ information
    covariance = np.empty_like(P)
    covariance[:d, :d] = posterior
    covariance[d:, :d] = gain @ posterior
    covariance[:d, d:] = covariance[d:, :d].T
    covariance[d:, d:] = P[d:, d:] - gain @ (P[:d, :d] - posterior) @ gain.T
    return FilterState(x, R, errors, state.rates + gain @ error, covariance), nis


def _linearised(
    model: WhitenedModel, y: FloatArray, body: MagnetBody, effects: FloatArray, state: FilterState
) -> tuple[FloatArray, FloatArray]:
    """Return the residual (C,) and its negative derivative (C, d) by pose and errors."""
    q = body.moment_root.shape[1]
    position_m = (model.centroid + model.radius * state.x)[None]
    unit = magnet_fields(body, sensors_m(model), position_m, state.R[None])
    strength = 1.0 + body.moment_root @ state.errors[:q]
    fields = MagnetFields(
        strength[:, None, None] * unit.field_T,
        strength[:, None, None, None] * unit.by_position,
        strength[:, None, None, None] * unit.by_rotation,
    )
    total_T = fields.field_T.sum(axis=1)
    gain = model.linear_gain(total_T)[0]
    of_pose = pose_jacobian(body, fields, state.R[None])[0] * np.repeat([model.radius, 1.0], 3)
    of_magnets = np.einsum("kna,kq->naq", unit.field_T[0], body.moment_root)
    by_field = np.concatenate([of_pose, of_magnets], axis=-1)[model.channel_sensor]
    columns = model.whiten(np.einsum("ca,caj->cj", gain, by_field)[None])[0]
    residual = (y - model.predict(total_T))[0] - effects.T @ state.errors[q:]
    return residual, np.concatenate([columns, effects.T], axis=1)
