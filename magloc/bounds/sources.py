"""Cramér-Rao bounds of many sources by a compiled kernel.

:mod:`magloc.bounds.crlb` is the readable reference.
"""

from __future__ import annotations

import numpy as np

from arrays.array import SensorArray
from arrays.pose import PoseUncertainty
from arrays.typing import FloatArray
from magloc import core
from magloc.fields.multipole import N_BODY_ERRORS, finite_body_errors

# Share of the information with all other parameters known below which a parameter counts as unknown.
_LOST_INFORMATION = 1e-12
_PRODUCTS_A_BLOCK = 10_000_000  # products of columns in one call: about two milliseconds


def array_model(
    array: SensorArray,
    *,
    ambient_uncertainty_T: float = 0.0,
    known_moment_sigma_Am2: float = np.inf,
    bodies: bool = False,
    lost: float = _LOST_INFORMATION,
) -> core.Problem:
    """Describe an array at rest to the kernel.

    Parameters
    ----------
    array : SensorArray
        Array with its noise and uncertainties.
    ambient_uncertainty_T, known_moment_sigma_Am2 : float
        See :func:`magloc.bounds.crlb.cramer_rao_bounds`.
    bodies : bool
        True if the sources are bodies, not points.
    lost : float
        The range is unknown if the other parameters leave less than this share of its information.

    Returns
    -------
    Problem
        The struct magloc_bound_array of magloc.h: the array without the positions of its sensors.
    """
    is_modulus = np.array([sensor.kind == "scalar" for sensor in array.sensors])
    common = np.inf if array.common_field_T is None else array.common_field_T
    ambient = ambient_uncertainty_T or array.row_ambient_uncertainty_T
    pose = array.pose or PoseUncertainty(position_constant_m=0.0, attitude_constant_rad=0.0)
    deviations = np.array(
        3 * [0.0 if is_modulus.all() else common]
        + [common if is_modulus.any() else 0.0]
        + 3 * [ambient if is_modulus.any() else 0.0]
        + 3 * [np.hypot(pose.attitude_rad, pose.attitude_constant_rad)]
        + 3 * [np.linalg.norm([pose.position_m, pose.position_white_m, pose.position_constant_m])]
        + (N_BODY_ERRORS * [1.0] if bodies else [])
    )
    nuisances = np.flatnonzero(deviations)
    errors = [(s.misalignment_rad, s.induced_uncertainty, s.gain_uncertainty) for s in array.sensors]
    misalignment, induced, gain_error = np.array(errors).T
    # Each modulus is read along a separate axis.
    rotation = np.where(is_modulus[:, None, None], np.eye(3), array.rotation_matrices)[array.channel_sensor]
    scale = gain_error[array.channel_sensor, None] * np.einsum("ci,cik->ck", array.channel_gain, rotation)
    return core.problem(
        "bound_array",
        n_sensors=array.n_sensors,
        n_channels=array.n_channels,
        n_nuisances=nuisances.size,
        n_errors=N_BODY_ERRORS if bodies else 0,
        ambient=np.ascontiguousarray(array.ambient_fields),
        is_modulus=is_modulus.astype(np.uint8),
        first_channel=np.append(array.sensor_channels[:, 0], array.n_channels).astype(np.int64),
        gain=np.ascontiguousarray(array.channel_gain),
        noise=np.ascontiguousarray(array.channel_noise_T),
        noise_depends_on_field=array.noise_depends_on_reading,
        errors_of_sensor=np.stack([misalignment, induced, array.noise_fractions], axis=1),
        gain_errors=np.ascontiguousarray(scale[..., None] * rotation.mT),
        nuisances=nuisances.astype(np.int64),
        prior=1.0 / deviations[nuisances],
        modulus_prior=1.0 / known_moment_sigma_Am2,
        lever_arm=tuple(pose.lever_arm_m),
        lost=lost,
    )


def source_bounds(
    model: core.Problem,
    sensors_m: FloatArray,
    positions_m: FloatArray,
    moments_Am2: FloatArray,
    *,
    length_m: FloatArray | None = None,
    slopes: FloatArray | None = None,
) -> FloatArray:
    """Return σ of range [m], bearing [rad] and position [m], shape (3, P, M).

    There are M moments at each of P places.

    Parameters
    ----------
    model : Problem
        Model from :func:`array_model`.
    sensors_m : ndarray, shape (N, 3)
        Positions of the sensors [m].
    positions_m : ndarray, shape (P, 3)
        Positions of the sources [m].
    moments_Am2 : ndarray, shape (M, 3) or (P, M, 3)
        The same moments at all places, or moments of each place [A·m²].
    length_m : ndarray, shape (P,), optional
        Lengths of the bodies, if the model has any [m].
    slopes : ndarray, shape (P, M, N, 3), optional
        Receives d log σ/d sensor for the σ of the range [1/m]. Valid only if noise does not depend on readings and a
        common field is the only nuisance.

    Returns
    -------
    ndarray, shape (3, P, M)
        Infinite where the information is singular; NaN for a source on a sensor or in the centroid.
    """
    n_places, n_moments = len(positions_m), moments_Am2.shape[-2]
    sigma = np.empty((3, n_places, n_moments))
    range_m, bearing_rad, position_m = sigma
    work = core.problem(
        "bounds",
        array=model,
        n_moments=n_moments,
        moments_are_own=moments_Am2.ndim == 3,
        sensors=np.ascontiguousarray(sensors_m),
        centroid=tuple(sensors_m.mean(axis=0).tolist()),
        positions=np.ascontiguousarray(positions_m),
        moments=np.ascontiguousarray(moments_Am2),
        body_errors=None if length_m is None else _body_errors(sensors_m, positions_m, length_m),
        sigma_range=range_m,
        sigma_bearing=bearing_rad,
        sigma_position=position_m,
        slopes=slopes,
    )
    products = model.struct.n_channels * (model.struct.n_nuisances + 6) ** 2
    core.run("source_bounds", work, n_places * n_moments, block=max(32, _PRODUCTS_A_BLOCK // products))
    return sigma


def _body_errors(sensors: FloatArray, positions: FloatArray, length_m: FloatArray) -> FloatArray:
    """Return matrices (P, N, 14, 6) of one σ of each body error, as upper triangles."""
    separation = sensors - positions[:, None]
    matrices = finite_body_errors(separation[:, :, None], np.eye(3), length_m[:, None, None, None, None])
    return np.ascontiguousarray(np.swapaxes(matrices[(..., *np.triu_indices(3), slice(None))], -1, -2))
