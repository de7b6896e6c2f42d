"""Readings and truth of a scenario."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.pose import PoseUncertainty
from arrays.sensor import Calibration
from arrays.typing import FloatArray
from magloc.fields.body import induced_and_permanent_moment
from magloc.fields.dipole import MU0_OVER_4PI, field
from magloc.fields.points import field_at_points
from magloc.readings import Readings
from magloc.signature.path import ObjectPath
from magloc.truth import Truth
from sims.magnetics.scenario import Carrier, MagneticScenario, Source
from sims.magnetics.sensors import SensorModel
from sims.noise import coloured_noise, lasting, low_passed, random_walk, stream

MU0 = 4.0 * math.pi * MU0_OVER_4PI
NEAREST_M = 1e-3
"""No sensor may come nearer to a source, whatever its size."""
_ALONG_BAR, _WEIGHTS = np.polynomial.legendre.leggauss(8)
"""Positions of dipoles in a bar, in half lengths, and twice their shares; the field is exact to 2e-7."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """One realisation of a scenario.

    Attributes
    ----------
    array : SensorArray
        Array as its user knows it.
    readings : Readings
        Readings with the stated pose of the array, unless its frame is the world's, and with the stated ambient field,
        if there is one, in the axes of that pose.
    truths : tuple of Truth
        Position and moment of every source at the times of the readings, world frame.
    paths : tuple of ObjectPath
        Stated position and attitude of every source, with their errors.
    true_array : SensorArray
        Array with its true calibration, including misalignments and errors of the gains.
    target_position_m, target_moment_Am2 : ndarray, shape (k, 3)
        Positions and moments of the targets in the ground, world frame.
    """

    scenario: MagneticScenario
    seed: int
    array: SensorArray
    readings: Readings
    truths: tuple[Truth, ...]
    paths: tuple[ObjectPath, ...]
    true_array: SensorArray
    target_position_m: FloatArray
    target_moment_Am2: FloatArray

    @property
    def truth(self) -> Truth:
        """Truth of the first source.

        Raises
        ------
        ValueError
            The scenario has no source.
        """
        if not self.truths:
            raise ValueError("Input scenario must have a source; instead received one without.")
        return self.truths[0]


@dataclass(frozen=True, eq=False)
class _Pose:
    """Position (n, 3) and attitude of a carrier in the world frame."""

    position_m: FloatArray
    rotation: Rotation


def simulate(scenario: MagneticScenario, seed: int) -> Simulation:
    """One realisation of a scenario.

    The field at every sensor is the sum of the ambient field with its pulsations, the platform and all sources at that
    instant. Then follow calibration with its errors, the sensor's low-pass, noise and drift, rounding, and saturation:
    a reading beyond the range is replaced by the limit of the range.
    ``seed``: the same seed gives the same numbers. Every feature of every sensor has its own stream,
    selected by the id: the removal of one changes no other.
    """
    time_s = scenario.time_s
    array_pose = _pose(scenario.carrier, time_s, seed, "array")
    sensors_m = array_pose.position_m[:, None, :] + _rotate(array_pose.rotation, scenario.array.positions[None])
    ambient_T = np.zeros(3) if scenario.ambient_T is None else np.array(scenario.ambient_T)
    varying_T = ambient_T + _pulsations(scenario, time_s, seed)
    fields_T = np.zeros_like(sensors_m) + varying_T[:, None, :]
    truths, poses = [], []
    for number, source in enumerate(scenario.sources, start=1):
        pose = _pose(source.carrier, time_s, seed, f"source {number}")
        moment_Am2 = _moments(source, pose.rotation, ambient_T)
        there = (time_s >= source.from_s) & (time_s <= source.until_s)
        _refuse_contact(scenario, number, time_s[there], (sensors_m - pose.position_m[:, None, :])[there])
        fields_T[there] += _source_fields(source, sensors_m, pose, moment_Am2)[there]
        truths.append(Truth(time_s[there], pose.position_m[there], moment_Am2[there]))
        poses.append(pose)
    buried = (np.zeros((0, 3)),) * 2 if scenario.targets is None else scenario.targets.draw(seed)
    fields_T += field_at_points(sensors_m.reshape(-1, 3), *buried).reshape(sensors_m.shape)
    if scenario.geology is not None:
        fields_T += scenario.geology.at(sensors_m, seed)
    fields_T = _rotate(array_pose.rotation.inv(), fields_T) + _platform_fields(scenario, time_s, seed)
    fields_T += _induced_fields(scenario, time_s, array_pose.rotation.inv().apply(varying_T), seed)
    fields_T += _stray_fields(scenario, seed)
    true_array = _true_array(scenario, seed)
    values_T = _sense(scenario, true_array.readings_of(fields_T), seed)
    present = np.ones(len(time_s), dtype=bool)
    for start, end in scenario.missing.gaps_s:
        present &= ~((time_s >= start) & (time_s <= end))
    if not present.any():
        raise ValueError("Input scenario must leave some rows; instead received gaps_s that leave none.")
    stated = array_pose if scenario.pose is None else _stated_pose(scenario, scenario.pose, time_s, seed)
    posed = not scenario.carrier.is_world or scenario.pose is not None
    readings = Readings(
        values_T[present],
        time_s=time_s[present],
        array_position_m=stated.position_m[present] if posed else None,
        array_rotation=stated.rotation[present] if posed else None,
        ambient_T=None if scenario.ambient_T is None else _stated_ambient(scenario, stated, seed)[present],
    )
    kept = tuple(_of_rows(truth, time_s[present]) for truth in truths)
    paths = tuple(_known_path(scenario, i, time_s, pose, seed) for i, pose in enumerate(poses))
    return Simulation(scenario, seed, scenario.nominal_array, readings, kept, paths, true_array, *buried)


def _pose(carrier: Carrier, time_s: FloatArray, seed: int, owner: str) -> _Pose:
    motion = carrier.path.at(time_s)
    phase = stream(seed, "wobble", owner).uniform(0.0, 2.0 * math.pi, 3)
    return _Pose(motion.position_m, carrier.attitude.at(time_s, motion.course_rad, phase))


def _stated_pose(scenario: MagneticScenario, of: PoseUncertainty, time_s: FloatArray, seed: int) -> _Pose:
    """Return the stated pose of the array, with the errors of :mod:`magloc.measurement.pose`."""
    random = stream(seed, "pose error").standard_normal((len(time_s), 7))
    changing = lasting(random, of.correlation_s, scenario.rate_Hz)
    constant = stream(seed, "pose constants").standard_normal(7)
    turn = of.attitude_rad * changing[:, :3] + of.attitude_constant_rad * constant[:3]
    lever_arm_m = np.array(of.lever_arm_m)
    true_lever_m = lever_arm_m + of.position_constant_m * constant[3:6]
    late_s = of.time_s * changing[:, 6] + of.time_constant_s * constant[6]
    true = _pose(scenario.carrier, time_s - late_s, seed, "array")
    rotation = true.rotation * Rotation.from_rotvec(-turn)
    reference_m = true.position_m - true.rotation.apply(true_lever_m) - of.position_m * changing[:, 3:6]
    reference_m = reference_m - of.position_white_m * stream(seed, "pose white").standard_normal((len(time_s), 3))
    return _Pose(reference_m + rotation.apply(lever_arm_m), rotation)


def _stated_ambient(scenario: MagneticScenario, stated: _Pose, seed: int) -> FloatArray:
    """Return the stated ambient field (n, 3) in the axes of the stated pose, with its errors."""
    constant = scenario.array.ambient_uncertainty_T * stream(seed, "ambient error").standard_normal(3)
    white = stream(seed, "white ambient error").standard_normal(stated.position_m.shape)
    field_T = np.asarray(scenario.ambient_T) + constant + scenario.array.ambient_uncertainty_white_T * white
    return np.asarray(stated.rotation.inv().apply(field_T))


def _known_path(scenario: MagneticScenario, number: int, time_s: FloatArray, pose: _Pose, seed: int) -> ObjectPath:
    """Return the known path of a source, with its errors."""
    error = scenario.sources[number].path_error
    if not error.sigma.size:
        return ObjectPath(time_s, pose.position_m, pose.rotation)
    random = stream(seed, "path error", f"source {number + 1}").standard_normal((len(time_s), 2, 3))
    walks = []
    for k, (sigma, lasts_s) in enumerate(
        ((error.position_m, error.position_correlation_s), (error.attitude_rad, error.attitude_correlation_s))
    ):
        walks.append(sigma * lasting(random[:, k], lasts_s, scenario.rate_Hz))
    return ObjectPath(time_s, pose.position_m + walks[0], Rotation.from_rotvec(walks[1]) * pose.rotation)


def _moments(source: Source, rotation: Rotation, ambient_T: FloatArray) -> FloatArray:
    """Return moments in the world frame (n, 3), permanent and induced."""
    polarisability = np.array(source.polarisability_m3) / MU0
    return induced_and_permanent_moment(rotation.as_matrix(), source.moment_Am2, polarisability, ambient_T)


def _source_fields(source: Source, sensors_m: FloatArray, pose: _Pose, moment_Am2: FloatArray) -> FloatArray:
    """Return fields of a source (n, N, 3), a dipole or dipoles along its bar, world frame."""
    if not source.body_length_m:
        return field(sensors_m, pose.position_m[:, None, :], moment_Am2[:, None, :])
    half_m = 0.5 * source.body_length_m * pose.rotation.as_matrix()[:, :, 0]
    total = np.zeros_like(sensors_m)
    for along, weight in zip(_ALONG_BAR, _WEIGHTS, strict=True):
        place_m = pose.position_m + along * half_m
        total += field(sensors_m, place_m[:, None, :], 0.5 * weight * moment_Am2[:, None, :])
    return total


def _refuse_contact(scenario: MagneticScenario, number: int, time_s: FloatArray, offset_m: FloatArray) -> None:
    """Refuse a sensor inside a source; offset (n, N, 3)."""
    if not len(time_s):  # the source is never there
        return
    distance = np.linalg.norm(offset_m, axis=-1)
    row, sensor = np.unravel_index(int(distance.argmin()), distance.shape)
    source = scenario.sources[number - 1]
    nearest = max(source.radius_m, source.body_length_m, NEAREST_M)
    if distance[row, sensor] < nearest:
        raise ValueError(
            f"Input scenario must keep its sensors at least {nearest:g} m from source {number}; "
            f"instead received sensor {scenario.array.ids[int(sensor)]} at {distance[row, sensor]:.3g} m "
            f"after {time_s[row]:g} s."
        )


def _pulsations(scenario: MagneticScenario, time_s: FloatArray, seed: int) -> FloatArray:
    """Return variations of the ambient field (n, 3), world frame."""
    total = np.zeros((len(time_s), 3))
    for number, pulsation in enumerate(scenario.pulsations, start=1):
        phase = stream(seed, "pulsation", str(number)).uniform(0.0, 2.0 * math.pi)
        wave = np.sin(2.0 * math.pi * time_s / pulsation.period_s + phase)
        total += wave[:, None] * np.array(pulsation.amplitude_T)
    return total


def _platform_fields(scenario: MagneticScenario, time_s: FloatArray, seed: int) -> FloatArray:
    """Return fields of the carrier at the sensors (n, N, 3), array frame."""
    platform, array = scenario.platform, scenario.array
    total = np.zeros((len(time_s), array.n_sensors, 3))
    if any(platform.moment_Am2):
        distance = np.linalg.norm(array.positions - platform.position_m, axis=1)
        if distance.min() < NEAREST_M:
            raise ValueError(
                f"Input scenario must keep its platform's dipole at least {NEAREST_M:g} m from the sensors; "
                f"instead received sensor {array.ids[int(distance.argmin())]} at {distance.min():.3g} m."
            )
        phase = 0.0
        if platform.frequency_Hz:
            phase = stream(seed, "platform dipole").uniform(0.0, 2.0 * math.pi)
        wave = np.cos(2.0 * math.pi * platform.frequency_Hz * time_s + phase)
        constant = field(array.positions, platform.position_m, platform.moment_Am2)
        total += wave[:, None, None] * constant
    if platform.noise_T:
        common = stream(seed, "platform noise").standard_normal((len(time_s), 1, 3))
        total += platform.noise_T * common
    return total


def _induced_fields(scenario: MagneticScenario, time_s: FloatArray, ambient_T: FloatArray, seed: int) -> FloatArray:
    """Return fields (n, N, 3) that an ambient field (n, 3) induces in the carrier, array frame.

    Tolles and Lawson's induced and eddy-current terms.
    """
    platform, names = scenario.platform, scenario.array.ids
    total = np.zeros((len(time_s), len(names), 3))
    causes = [(platform.induced, "induced", ambient_T)]
    if platform.eddy_s and len(time_s) > 1:  # one row shows no change
        causes.append((platform.eddy_s, "eddy currents", np.gradient(ambient_T, time_s, axis=0)))
    for size, cause, field_T in causes:
        if size:
            drawn = size * np.stack([stream(seed, cause, name).standard_normal((3, 3)) for name in names])
            total += np.einsum("sij,nj->nsi", drawn, field_T)
    return total


def _stray_fields(scenario: MagneticScenario, seed: int) -> FloatArray:
    """Return constant fields at the sensors (N, 3) that turn with the array."""
    return np.stack(
        [
            model.offset_error_T * stream(seed, "offset", name).standard_normal(3)
            for name, model in zip(scenario.array.ids, scenario.models, strict=True)
        ]
    )


def _true_array(scenario: MagneticScenario, seed: int) -> SensorArray:
    """Return the array with the true calibration of its sensors.

    A vector sensor of nominal scale S reads S diag(1 + g) R b: R is a random rotation, g a random error of the gains.
    """
    sensors = []
    for sensor, model in zip(scenario.array.sensors, scenario.models, strict=True):
        gains = 1.0 + model.gain_error * stream(seed, "gain", sensor.id).standard_normal(sensor.n_channels)
        scale = np.array(sensor.calibration.scale) @ np.diag(gains)
        if sensor.kind == "vector":
            turn = model.misalignment_rad * stream(seed, "misalignment", sensor.id).standard_normal(3)
            scale = scale @ Rotation.from_rotvec(turn).as_matrix()
        calibration = Calibration.of(sensor.kind, scale, sensor.calibration.offset_T)
        sensors.append(replace(sensor, calibration=calibration))
    return replace(scenario.array, sensors=tuple(sensors))


def _sense(scenario: MagneticScenario, clean_T: FloatArray, seed: int) -> FloatArray:
    """Return noisy readings (n, C) from clean ones; NaN for missing samples."""
    values = np.empty_like(clean_T)
    for i, (name, model) in enumerate(zip(scenario.array.ids, scenario.models, strict=True)):
        channels = scenario.array.channel_sensor == i
        values[:, channels] = _read(model, clean_T[:, channels], scenario.rate_Hz, seed, name)
        lost = stream(seed, "dropout", name).random(len(values)) < scenario.missing.dropout
        values[np.ix_(lost, channels)] = np.nan
    return values


def _read(model: SensorModel, clean_T: FloatArray, rate_Hz: float, seed: int, name: str) -> FloatArray:
    """Return the readings of one sensor (n, c)."""
    n, channels = clean_T.shape
    values = low_passed(clean_T, rate_Hz, model.bandwidth_Hz)
    values = values + coloured_noise(
        n, channels, rate_Hz, model.noise_T_rtHz, model.corner_Hz, model.bandwidth_Hz, stream(seed, "noise", name)
    )
    values += random_walk(n, channels, rate_Hz, model.drift_T_rth, stream(seed, "drift", name))
    if model.resolution_T:
        values = np.round(values / model.resolution_T) * model.resolution_T
    # Last, or rounding could lift a saturated reading off the limit by which it is known.
    return np.clip(values, -model.range_T, model.range_T)


def _of_rows(truth: Truth, time_s: FloatArray) -> Truth:
    """Return a truth at the instants with readings."""
    rows = np.isin(truth.time_s, time_s)
    moments = None if truth.moment_Am2 is None else truth.moment_Am2[rows]
    return Truth(truth.time_s[rows], truth.position_m[rows], moments)


def _rotate(rotation: Rotation, vectors: FloatArray) -> FloatArray:
    """Rotate vectors (n, N, 3), or (1, N, 3), by the rotation of every instant."""
    return np.einsum("tij,tkj->tki", rotation.as_matrix(), vectors)
