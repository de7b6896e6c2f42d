"""Scenario files of ``adcs`` (TOML): satellite, orbit, sensors, disturbances and estimator.

``scenarios/tabletsat.toml`` documents every key and has the values of Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh
Institute preprint 64, 2014. These values are the defaults, except in the tables ``satellite`` and ``orbit``. The other
files in that folder are named problems of the same paper.
"""

from __future__ import annotations

import datetime
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from adcs.environment.orbit import Orbit, Sgp4Orbit, circular_orbit
from adcs.frames import instants
from adcs.io.ccsds import read_oem
from adcs.io.log_layout import LogLayout
from adcs.io.scenario_tables import (
    SENSOR_TABLES,
    DisturbanceTable,
    EstimateTable,
    FileTable,
    OrbitTable,
    ProcessNoiseTable,
    SatelliteTable,
    StartTable,
)
from adcs.kalman.bank import IMPLIED_STATES, EstimatorSettings
from adcs.kalman.error_state import DISTURBANCE_S2, FilterSettings, ProcessNoise, SensorSet, sensor_set
from adcs.kalman.names import FILTERS, NOISES, STARTS
from adcs.kalman.process_noise import paper_noise, torque_scale, tuned_noise
from adcs.satellite.dynamics import RigidBody, WheelControl, wheel_control
from adcs.satellite.satellite import Satellite
from arrays.io.errors import InputError, naming
from arrays.io.toml import BuiltIn, section_of, toml_value
from arrays.typing import FloatArray
from magloc.fields.geomagnetic import Model

_FILES = BuiltIn("adcs", "scenarios", "scenario")
built_in_scenarios = _FILES.names


@dataclass(frozen=True, eq=False)
class AttitudeFile:
    """Scenario file, read and checked."""

    name: str
    path: str  # path of the file, for errors
    tables: dict[str, Any]  # tables as read
    satellite: Satellite  # runs start within 24 hours after its start
    duration_s: float
    step_s: float
    start: StartTable
    disturbance: DisturbanceTable
    estimate: EstimateTable
    log: LogLayout | None = None  # layout of a log with other columns than the standard ones

    def changed(self, changes: dict[str, Any]) -> AttitudeFile:
        """Return the scenario with some keys replaced; a dict replaces keys of the table with its name."""
        tables = dict(self.tables)
        for key, value in changes.items():
            tables[key] = {**tables.get(key, {}), **value} if isinstance(value, dict) else value
        return scenario_of(self.path, tables)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on uncertain parts of the scenario: old two-line elements."""
        orbit, start = self.satellite.orbit, np.array(self.satellite.start)
        return tuple(filter(None, [orbit.age_warning(start)])) if isinstance(orbit, Sgp4Orbit) else ()

    def estimator(self, place: str = "") -> EstimatorSettings:
        """Return the settings of the table ``estimate``; errors name ``place``, by default the file."""
        return _estimator(place or self.path, self.estimate, self.satellite.body.inertia_kgm2)


def read_scenario(name_or_path: str, *, allow_old_elements: bool = False) -> AttitudeFile:
    """Read the scenario of a satellite.

    Parameters
    ----------
    name_or_path : str
        Name of a built-in scenario, or a TOML file; ``scenarios/tabletsat.toml`` documents the keys.
    allow_old_elements : bool
        Accept two-line elements 30 days or more from their epoch, as the key with that name.

    Returns
    -------
    AttitudeFile
        Satellite, runs and estimator of the scenario, and the layout of its log.

    Raises
    ------
    InputError
        The file cannot be read, is not a scenario, or has two-line elements that are too old; the text says why.

    Examples
    --------
    >>> import adcs
    >>> adcs.read_scenario("tabletsat").satellite.field_model
    'IGRF-14'
    """
    return scenario_of(*scenario_table(name_or_path), allow_old_elements=allow_old_elements)


def scenario_table(name_or_path: str) -> tuple[str, dict[str, Any]]:
    """Return the path and the table of a scenario."""
    return _FILES.read(name_or_path)


def scenario_text(file: AttitudeFile) -> str:
    """Return the scenario as the text of a TOML file, without comments."""
    lines = [f"{key} = {toml_value(value)}" for key, value in file.tables.items() if not isinstance(value, dict)]
    for name, table in file.tables.items():
        if isinstance(table, dict):
            lines += _table_lines(name, table)
    return "\n".join([*lines, ""])


def _table_lines(name: str, table: dict[str, Any]) -> list[str]:
    plain = {key: value for key, value in table.items() if not isinstance(value, dict)}
    lines = ["", f"[{name}]"] if plain or not table else []
    lines += [f"{key} = {toml_value(value)}" for key, value in plain.items()]
    for key, value in table.items():
        if isinstance(value, dict):
            lines += _table_lines(f"{name}.{key}", value)
    return lines


def scenario_of(path: str, tables: dict[str, Any], *, allow_old_elements: bool = False) -> AttitudeFile:
    """Return the scenario of the tables of a file, as :func:`arrays.io.toml.read_toml` returns them."""
    orbit = tables.get("orbit")
    if allow_old_elements and isinstance(orbit, dict) and "elements" in orbit:
        tables = {**tables, "orbit": {**orbit, "allow_old_elements": True}}
    file = section_of(path, tables, FileTable)
    body, control = _satellite(f"{path}, table satellite", file.satellite)
    orbit, start_utc, model = _orbit(path, f"{path}, table orbit", file.orbit)
    for name in file.sensors:
        if name not in SENSOR_TABLES:
            raise InputError(
                f"{path}, table sensors: found the unknown sensor {name!r}, expected one of {', '.join(SENSOR_TABLES)}."
            )
    sensors = {}
    for name, struct in SENSOR_TABLES.items():
        place = f"{path}, table sensors.{name}"
        table = section_of(place, file.sensors.get(name, {}), struct)
        with naming(place):
            sensors[name] = table.sensor()
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
        start=file.start,
        disturbance=file.disturbance,
        estimate=file.estimate,
        log=None if file.log is None else LogLayout.of(f"{path}, table log", file.log, start_utc),
    )


def _estimator(place: str, table: EstimateTable, inertia_kgm2: FloatArray) -> EstimatorSettings:
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
                _process_noise(place, table.process_noise, used, inertia_kgm2),
                field_error_T=1e-9 * table.field_model_error_nT,
                field_bias_sigma_T=1e-9 * table.field_bias_nT,
                gyro_bias_sigma_rad_s=math.radians(table.gyro_bias_deg_s),
                disturbance_sigma_s2=table.disturbance_s2 or DISTURBANCE_S2 * torque_scale(inertia_kgm2),
                dipole_sigma_Am2=table.dipole_Am2,
                field_gain_sigma=table.field_gain,
                field_axes_sigma_rad=math.radians(table.field_axes_deg),
                field_correlation_s=table.field_model_correlation_s,
                gate=table.gate,
            ),
            filter=table.filter,  # type: ignore[arg-type]
            start=table.start,  # type: ignore[arg-type]
            start_attitude_rad=math.radians(table.start_error_deg),
            start_rate_rad_s=math.radians(table.start_rate_error_deg_s),
            forgetting=table.forgetting,
            closed_loop_F=table.closed_loop_F,
            longest_gap_s=table.longest_gap_s,
        )


def _process_noise(place: str, wanted: str | dict[str, Any], used: SensorSet, inertia_kgm2: FloatArray) -> ProcessNoise:
    if wanted == "paper":
        return paper_noise(used)
    tuned = tuned_noise(used, inertia_kgm2)
    if wanted == "tuned":
        return tuned
    if isinstance(wanted, str):
        raise InputError(f"{place}, process_noise: found {wanted!r}, expected {', '.join(NOISES)} or a table.")
    table = section_of(f"{place}, table process_noise", wanted, ProcessNoiseTable)
    given = {key: value for key, value in msgspec.structs.asdict(table).items() if value is not None}
    if "field_bias_nT" in given:
        given["field_bias_T"] = 1e-9 * given.pop("field_bias_nT")
    if "half_angle_rad" in given:
        given["attitude"] = given.pop("half_angle_rad")
    return replace(tuned, **given)


def _satellite(place: str, section: SatelliteTable) -> tuple[RigidBody, WheelControl]:
    with naming(place):
        body = RigidBody(np.array(section.inertia_kgm2), np.array(section.residual_dipole_Am2))
        control = replace(
            wheel_control(body, section.control_rad_s, section.control_damping),
            torque_limit_Nm=section.torque_limit_Nm,
            momentum_limit_Nms=section.momentum_limit_Nms,
        )
    return body, control


def _orbit(path: str, place: str, section: OrbitTable) -> tuple[Orbit, np.datetime64, Model]:
    start: np.datetime64 = instants(datetime.datetime.fromisoformat(section.start))[()]  # type: ignore[assignment]
    if section.elements is not None:
        with naming(f"{place}, key elements"):
            of_elements = Sgp4Orbit(*section.elements, allow_old_elements=section.allow_old_elements)
            of_elements.refuse_old(instants(start))
        return of_elements, start, section.field_model
    if section.ephemeris is not None:
        # The path is relative to the scenario file, not to the working directory.
        return read_oem(Path(path).parent / section.ephemeris), start, section.field_model
    with naming(place):
        orbit = circular_orbit(
            altitude_m=1e3 * (section.altitude_km or 0.0),
            inclination_deg=section.inclination_deg or 0.0,
            epoch=start,
            node_deg=section.node_deg,
            local_time_h=section.local_time_h,
            latitude_argument_deg=section.latitude_argument_deg,
        )
    return orbit, start, section.field_model
