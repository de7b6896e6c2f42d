"""Scenario files of ``adcs`` (TOML): a satellite, its orbit and sensors, what disturbs it, and what is estimated.

``scenarios/tabletsat.toml`` beside this file documents every key and has the values of Ivanov, Ivlev, Karpenko,
Ovchinnikov, Keldysh Institute preprint 64, 2014; every key that a file leaves out has the value that stands there,
except those of the tables ``satellite`` and ``orbit``. The other files there are the named problems of that paper.
"""

from __future__ import annotations

import datetime
import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from adcs.environment.orbit import Orbit, Sgp4Orbit, circular_orbit
from adcs.io.scenario_tables import (
    FORMAT_VERSION,
    SENSOR_TABLES,
    DisturbanceTable,
    EstimateTable,
    FileTable,
    GyroTable,
    MagnetometerTable,
    OrbitTable,
    ProcessNoiseTable,
    SatelliteTable,
    StarTrackerTable,
    StartTable,
    SunSensorTable,
)
from adcs.kalman.bank import IMPLIED_STATES, EstimatorSettings
from adcs.kalman.error_state import FilterSettings, ProcessNoise, SensorSet, paper_noise, sensor_set, tuned_noise
from adcs.kalman.names import FILTERS, NOISES, STARTS
from adcs.satellite.dynamics import RigidBody, WheelControl, wheel_control
from adcs.satellite.satellite import Satellite
from adcs.satellite.sensors import Gyro, Magnetometer, StarTracker, SunSensor
from arrays.io.errors import InputError, naming
from arrays.io.toml import read_toml, section_of
from magloc.fields.geomagnetic import MODELS, Model

MOST_STEPS = 200_000
"""Of a run: its covariances are held together, 230 MB of them."""


@dataclass(frozen=True, eq=False)
class AttitudeFile:
    """A scenario file.

    Attributes
    ----------
    name : str
    path : str
        Of the file, for errors.
    tables : dict
        As read.
    satellite : Satellite
        Runs start within the 24 hours from its start.
    duration_s, step_s : float
    start : StartTable
    disturbance : DisturbanceTable
    estimate : EstimateTable
    """

    name: str
    path: str
    tables: dict[str, Any]
    satellite: Satellite
    duration_s: float
    step_s: float
    start: StartTable
    disturbance: DisturbanceTable
    estimate: EstimateTable

    def changed(self, changes: dict[str, Any]) -> AttitudeFile:
        """The scenario with some keys replaced; keys of a table in a table of the changes."""
        tables = dict(self.tables)
        for key, value in changes.items():
            tables[key] = {**tables.get(key, {}), **value} if isinstance(value, dict) else value
        return scenario_of(self.path, tables)

    def estimator(self, place: str = "") -> EstimatorSettings:
        """What the table ``estimate`` orders, checked; errors name a place, or the file."""
        return _estimator(place or self.path, self.estimate)


def built_in_scenarios() -> tuple[str, ...]:
    """Names of the scenarios that come with the package."""
    files = (resources.files("adcs") / "scenarios").iterdir()
    return tuple(sorted(Path(file.name).stem for file in files if file.name.endswith(".toml")))


def built_in_text(name: str) -> str:
    """Text of a built-in scenario's file."""
    return (resources.files("adcs") / "scenarios" / f"{name}.toml").read_text(encoding="utf-8")


def read_scenario(name_or_path: str) -> AttitudeFile:
    """Scenario of a satellite.

    Parameters
    ----------
    name_or_path : str
        A built-in scenario's name, or a TOML file; ``scenarios/tabletsat.toml`` beside this module documents the keys.

    Returns
    -------
    AttitudeFile

    Raises
    ------
    InputError
        The file cannot be read or does not describe a scenario; the text says where and why.
    """
    path = name_or_path
    if name_or_path in built_in_scenarios():
        path = str(resources.files("adcs") / "scenarios" / f"{name_or_path}.toml")
    expected = f"a scenario file, or one of the built-in scenarios {', '.join(built_in_scenarios())}"
    return scenario_of(path, _with_dates(read_toml(path, expected)))


def scenario_text(file: AttitudeFile) -> str:
    """The scenario as text of a TOML file, without comments."""
    lines = [f"{key} = {_toml(value)}" for key, value in file.tables.items() if not isinstance(value, dict)]
    for name, table in file.tables.items():
        if isinstance(table, dict):
            lines += _table_lines(name, table)
    return "\n".join([*lines, ""])


def _table_lines(name: str, table: dict[str, Any]) -> list[str]:
    plain = {key: value for key, value in table.items() if not isinstance(value, dict)}
    lines = ["", f"[{name}]"] if plain or not table else []
    lines += [f"{key} = {_toml(value)}" for key, value in plain.items()]
    for key, value in table.items():
        if isinstance(value, dict):
            lines += _table_lines(f"{name}.{key}", value)
    return lines


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return str(value) if math.isfinite(value) else f"{float(value)}"


def scenario_of(path: str, tables: dict[str, Any]) -> AttitudeFile:
    """Scenario of the tables of a file.

    Parameters
    ----------
    path : str
        Of the file, for errors.
    tables : dict
        As :func:`arrays.io.toml.read_toml` returns them.

    Returns
    -------
    AttitudeFile

    Raises
    ------
    InputError
        They do not describe a scenario; the text says where and why.
    """
    file = section_of(path, tables, FileTable)
    if file.format_version != FORMAT_VERSION:
        raise InputError(f"{path}, key format_version: found {file.format_version}, expected {FORMAT_VERSION}.")
    body, control = _satellite(f"{path}, table satellite", file.satellite)
    orbit, start_utc, model = _orbit(f"{path}, table orbit", file.orbit)
    if not 1.0 <= file.duration_s / file.step_s <= MOST_STEPS:
        raise InputError(
            f"{path}, key duration_s: found {file.duration_s:g} s, expected 1 to {MOST_STEPS} steps of "
            f"{file.step_s:g} s."
        )
    if file.name is not None and not re.fullmatch(r"[\w.-]+", file.name):
        raise InputError(f"{path}, key name: found {file.name!r}, expected letters, digits, dots and dashes.")
    for name in file.sensors:
        if name not in SENSOR_TABLES:
            raise InputError(
                f"{path}, table sensors: found the unknown sensor {name!r}, expected one of {', '.join(SENSOR_TABLES)}."
            )
    sensors = {
        name: make(f"{path}, table sensors.{name}", file.sensors.get(name, {})) for name, make in _MAKERS.items()
    }
    start = section_of(f"{path}, table start", file.start, StartTable)
    for key in ("least_separation_deg", "most_separation_deg"):
        if not 0.0 <= getattr(start, key) <= 90.0:
            raise InputError(f"{path}, table start, key {key}: found {getattr(start, key):g}, expected 0 to 90.")
    return AttitudeFile(
        name=Path(path).stem if file.name is None else file.name,
        path=path,
        tables=tables,
        satellite=Satellite(
            inertia_kgm2=body.inertia_kgm2,
            residual_dipole_Am2=body.residual_dipole_Am2,
            control=control,
            orbit=orbit,
            start=start_utc,
            field_model=model,
            **sensors,
        ),
        duration_s=file.duration_s,
        step_s=file.step_s,
        start=start,
        disturbance=section_of(f"{path}, table disturbance", file.disturbance, DisturbanceTable),
        estimate=section_of(f"{path}, table estimate", file.estimate, EstimateTable),
    )


def _estimator(place: str, table: EstimateTable) -> EstimatorSettings:
    for key, known in (("filter", FILTERS), ("start", STARTS)):
        if getattr(table, key) not in known:
            raise InputError(f"{place}, {key}: found {getattr(table, key)!r}, expected one of {', '.join(known)}.")
    if not 0.0 < table.forgetting <= 1.0:
        raise InputError(f"{place}, forgetting: found {table.forgetting:g}, expected more than 0 and at most 1.")
    if table.closed_loop_F and table.filter != "mekf":
        raise InputError(f"{place}, closed_loop_F: found the filter {table.filter}, expected mekf.")
    states = [*table.states, *(state for state in IMPLIED_STATES.get(table.filter, ()) if state not in table.states)]
    with naming(place):
        used = sensor_set(table.sensors, states)
        return EstimatorSettings(
            settings=FilterSettings(
                used,
                _process_noise(place, table.process_noise, used),
                field_error_T=1e-9 * table.field_model_error_nT,
                field_bias_sigma_T=1e-9 * table.field_bias_nT,
                gyro_bias_sigma_rad_s=math.radians(table.gyro_bias_deg_s),
                disturbance_sigma_s2=table.disturbance_s2,
            ),
            filter=table.filter,  # type: ignore[arg-type]
            start=table.start,  # type: ignore[arg-type]
            start_attitude_rad=math.radians(table.start_error_deg),
            start_rate_rad_s=math.radians(table.start_rate_error_deg_s),
            forgetting=table.forgetting,
            closed_loop_F=table.closed_loop_F,
        )


def _process_noise(place: str, wanted: str | dict[str, Any], used: SensorSet) -> ProcessNoise:
    if wanted == "paper":
        return paper_noise(used)
    tuned = tuned_noise(used)
    if wanted == "tuned":
        return tuned
    if isinstance(wanted, str):
        raise InputError(f"{place}, process_noise: found {wanted!r}, expected {', '.join(NOISES)} or a table.")
    table = section_of(f"{place}, table process_noise", wanted, ProcessNoiseTable)
    given = {key: getattr(table, key) for key in table.__struct_fields__ if getattr(table, key) is not None}
    return ProcessNoise(
        attitude=given.get("half_angle_rad", tuned.attitude),
        rate_rad_s=given.get("rate_rad_s", tuned.rate_rad_s),
        field_bias_T=1e-9 * given["field_bias_nT"] if "field_bias_nT" in given else tuned.field_bias_T,
        gyro_bias_rad_s=given.get("gyro_bias_rad_s", tuned.gyro_bias_rad_s),
        disturbance_s2=given.get("disturbance_s2", tuned.disturbance_s2),
    )


def _satellite(place: str, table: dict[str, Any]) -> tuple[RigidBody, WheelControl]:
    section = section_of(place, table, SatelliteTable)
    with naming(place):
        body = RigidBody(np.array(section.inertia_kgm2), np.array(section.residual_dipole_Am2))
        gains = wheel_control(body, section.control_rad_s, section.control_damping)
        control = WheelControl(
            gains.attitude_gain_Nm, gains.rate_gain_Nms, section.torque_limit_Nm, section.momentum_limit_Nms
        )
    return body, control


def _orbit(place: str, table: dict[str, Any]) -> tuple[Orbit, np.datetime64, Model]:
    section = section_of(place, table, OrbitTable)
    if section.field_model not in MODELS:
        raise InputError(f"{place}, key field_model: found {section.field_model!r}, expected one of {_listed(MODELS)}.")
    start = _instant(f"{place}, key start", section.start)
    circle = {key: getattr(section, key) for key in ("altitude_km", "inclination_deg")}
    if section.elements is not None:
        if any(value is not None for value in (*circle.values(), section.local_time_h, section.node_deg)):
            raise InputError(f"{place}: found elements and a circle, expected one of them.")
        with naming(f"{place}, key elements"):
            return Sgp4Orbit(*section.elements), start, section.field_model
    for key, value in circle.items():
        if value is None:
            raise InputError(f"{place}: found no key {key}, expected one, or two-line elements.")
    if (section.local_time_h is None) == (section.node_deg is None):
        found = "neither local_time_h nor node_deg" if section.node_deg is None else "both local_time_h and node_deg"
        raise InputError(f"{place}: found {found}, expected one of them.")
    with naming(place):
        orbit = circular_orbit(
            altitude_m=1e3 * circle["altitude_km"],
            inclination_deg=circle["inclination_deg"],
            epoch=start,
            node_deg=section.node_deg,
            local_time_h=section.local_time_h,
            latitude_argument_deg=section.latitude_argument_deg,
        )
    return orbit, start, section.field_model


def _with_dates(table: dict[str, Any]) -> dict[str, Any]:
    """TOML has dates of its own; here they are text, so that both are allowed."""
    orbit = table.get("orbit")
    if isinstance(orbit, dict) and isinstance(orbit.get("start"), datetime.date):
        return {**table, "orbit": {**orbit, "start": orbit["start"].isoformat()}}
    return table


def _instant(place: str, text: str) -> np.datetime64:
    try:
        date = datetime.datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"{place}: found {text!r}, expected an instant such as 2014-09-01T12:00:00 (UTC).") from None
    if date.tzinfo is not None:
        date = date.astimezone(datetime.UTC).replace(tzinfo=None)
    return np.datetime64(date, "us")


def _star_tracker(place: str, table: dict[str, Any]) -> StarTracker:
    section = section_of(place, table, StarTrackerTable)
    with naming(place):
        return StarTracker(
            sigma_rad=0.5 * math.radians(section.noise_deg),
            rate_limit_rad_s=math.radians(section.rate_limit_deg_s),
            boresight_body=np.array(section.boresight),
            sun_exclusion_rad=math.radians(section.sun_exclusion_deg),
            earth_exclusion_rad=math.radians(section.earth_exclusion_deg),
            misalignment_rad=np.radians(section.misalignment_deg),
        )


def _gyro(place: str, table: dict[str, Any]) -> Gyro:
    section = section_of(place, table, GyroTable)
    with naming(place):
        return Gyro(
            sigma_rad_s=math.radians(section.noise_deg_s),
            range_rad_s=math.radians(section.range_deg_s),
            bias_walk_rad_s=math.radians(section.bias_walk_deg_s_rts),
            misalignment_rad=np.radians(section.misalignment_deg),
        )


def _magnetometer(place: str, table: dict[str, Any]) -> Magnetometer:
    section = section_of(place, table, MagnetometerTable)
    with naming(place):
        return Magnetometer(
            sigma_T=1e-9 * section.noise_nT,
            range_T=1e-9 * section.range_nT,
            bias_walk_T=1e-9 * section.bias_walk_nT_rts,
            misalignment_rad=np.radians(section.misalignment_deg),
        )


def _sun_sensor(place: str, table: dict[str, Any]) -> SunSensor:
    section = section_of(place, table, SunSensorTable)
    with naming(place):
        return SunSensor(
            sigma_rad=math.radians(section.noise_deg),
            heads_body=np.array(section.heads, dtype=np.float64),
            half_field_rad=math.radians(section.half_field_deg),
            misalignment_rad=np.radians(section.misalignment_deg),
        )


_MAKERS: dict[str, Callable[[str, dict[str, Any]], Any]] = {
    "star_tracker": _star_tracker,
    "gyro": _gyro,
    "magnetometer": _magnetometer,
    "sun_sensor": _sun_sensor,
}


def _listed(names: Any) -> str:
    return ", ".join(map(str, names))
