"""What the compiled Cramér-Rao bounds of :mod:`magloc.bounds.table_compiled` need of an array.

And the axes they work in.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.pose import PoseUncertainty
from arrays.typing import FloatArray
from magloc.compilation import internal

# Information about a parameter that is less than this part of what it would be were the others known is none.
LOST_INFORMATION = 1e-12
# Nuisances: components of the common field, its modulus for scalar sensors, components of the ambient field's error,
# turns of the array, its shifts, and what a dipole leaves out of a body.
COMMON, COMMON_MODULUS, AMBIENT, TURN, SHIFT, BODY = 0, 3, 4, 7, 10, 13


class BoundModel(NamedTuple):
    """What the kernel needs of an array.

    Attributes
    ----------
    centroid : ndarray, shape (3,)
    sensors : ndarray, shape (N, 3)
        Positions [m].
    ambient : ndarray, shape (N, 3)
        Ambient field at the sensors [T].
    scalar : ndarray of bool, shape (N,)
    channel : ndarray, shape (N,)
        First channel of every sensor.
    axes : ndarray, shape (C, 3)
        Row a of every vector channel; (g, 0, 0) of a scalar one.
    rotations, scales : ndarray, shape (N, 3, 3)
        From the sensors' axes to the array's; calibration.
    noise : ndarray, shape (C,)
        [T]
    uncertainty : ndarray, shape (N, 3)
        Standard deviations of turns [rad], gains, and of what the field induces in the carrier, over it.
    noise_fraction : ndarray, shape (N,)
    nuisances : ndarray, shape (q,)
        Which ones there are.
    prior : ndarray, shape (q,)
        Their inverse standard deviations, 0 if nothing is known [1/T, 1/rad, 1/m, 1].
    lever_arm : ndarray, shape (3,)
        From the point about which the array turns to its origin [m].
    modulus_prior : float
        Inverse standard deviation of what is known of the moment's modulus, 0 if nothing is [1/(A·m²)].
    varies : bool
        Whether axes, noise, nuisances or what is known depend on the moment.
    """

    centroid: FloatArray
    sensors: FloatArray
    ambient: FloatArray
    scalar: NDArray[np.bool_]
    channel: NDArray[np.intp]
    axes: FloatArray
    rotations: FloatArray
    scales: FloatArray
    noise: FloatArray
    uncertainty: FloatArray
    noise_fraction: FloatArray
    nuisances: NDArray[np.intp]
    prior: FloatArray
    lever_arm: FloatArray
    modulus_prior: float
    varies: bool

    @classmethod
    def of(
        cls, array: SensorArray, ambient_uncertainty_T: float, known_moment_sigma_Am2: float, n_body_errors: int
    ) -> BoundModel:
        """Model of an array at rest, its ambient field known to a σ [T] per axis, the moment's modulus to another.

        Sources are points, or bodies of as many independent errors as given.
        """
        scales = np.tile(np.eye(3), (array.n_sensors, 1, 1))
        for scale, sensor in zip(scales, array.sensors, strict=True):
            scale[: sensor.n_channels, : sensor.n_channels] = sensor.calibration.scale
        scalar = np.array([sensor.kind == "scalar" for sensor in array.sensors])
        common = math.inf if array.common_field_T is None else array.common_field_T
        deviation = 3 * [0.0 if scalar.all() else common]
        deviation += [common if scalar.any() else 0.0]
        deviation += 3 * [(ambient_uncertainty_T or array.row_ambient_uncertainty_T) if scalar.any() else 0.0]
        pose = array.pose or PoseUncertainty(position_constant_m=0.0, attitude_constant_rad=0.0)
        deviation += 3 * [math.hypot(pose.attitude_rad, pose.attitude_constant_rad)]
        deviation += 3 * [math.hypot(pose.position_m, pose.position_white_m, pose.position_constant_m)]
        deviation += n_body_errors * [1.0]
        nuisances = np.flatnonzero(deviation)
        constant = nuisances.max(initial=0) < COMMON_MODULUS and not array.noise_depends_on_reading
        return cls(
            centroid=read_only(array.centroid),
            sensors=read_only(array.positions),
            ambient=read_only(array.ambient_fields),
            scalar=read_only(scalar),
            channel=read_only(array.sensor_channels[:, 0]),
            axes=read_only(array.channel_gain),
            rotations=read_only(array.rotation_matrices),
            scales=read_only(scales),
            noise=read_only(array.channel_noise_T),
            uncertainty=read_only(
                np.array([(s.misalignment_rad, s.gain_uncertainty, s.induced_uncertainty) for s in array.sensors])
            ),
            noise_fraction=read_only(array.noise_fractions),
            nuisances=read_only(nuisances),
            prior=read_only(1.0 / np.array(deviation)[nuisances]),
            lever_arm=read_only(np.array(pose.lever_arm_m)),
            modulus_prior=1.0 / known_moment_sigma_Am2,
            varies=bool(scalar.any() or not constant or known_moment_sigma_Am2 < math.inf),
        )


def read_only(values: NDArray) -> NDArray:  # type: ignore[type-arg]
    """Contiguous and read-only: numba compiles again for each mix of both."""
    array = np.ascontiguousarray(values).view()
    array.setflags(write=False)
    return array


@internal
def turned(frame: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Components of a vector along the rows of a frame."""
    return (
        frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z,
        frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z,
        frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z,
    )
