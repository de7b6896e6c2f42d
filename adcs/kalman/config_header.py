"""Settings of a satellite's filter as a C++ header for its own computer."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict

from adcs.kalman.error_state import STATES
from adcs.kalman.satellite_filter import SatelliteFilter
from adcs.satellite.sensors import SENSORS


def satellite_header(name: str, board: SatelliteFilter) -> str:
    """Return a C++ header with the type and the settings of a filter; ``name`` is for its first line."""
    used = board.settings.sensors
    plain = "".join(char for char in name if char.isprintable() and char not in "\\?") or "without a name"
    states = "".join(f", adcs::State::{state.replace('-', '_')}" for state in used.states)
    assignments = [f"  c.{place} = {value};" for place, value in _assignments(board)]
    lines = [
        f"// Filter of a satellite, {plain}: written by magloc export-config. SI units.",
        f"// Sensors {used.sensors}; states {', '.join(('attitude', 'rate', *used.states))}.",
        "#pragma once",
        '#include "adcs/satellite_filter.hpp"',
        "namespace satellite {",
        "template <class Real = double>",
        f"using Filter = adcs::SatelliteFilter<Real{states}>;",
        "template <class Real = double>",
        "adcs::SatelliteConfig<Real> config() {",
        "  adcs::SatelliteConfig<Real> c = {};",
        *assignments,
        "  return c;",
        "}",
        "}  // namespace satellite",
    ]
    return "\n".join(lines) + "\n"


def _assignments(board: SatelliteFilter) -> Iterator[tuple[str, str]]:
    """Yield members of ``SatelliteConfig`` with their values."""
    satellite, settings, noise = board.satellite, board.settings, asdict(board.settings.noise)
    for i, row in enumerate(satellite.body.inertia_kgm2.tolist()):
        yield from ((f"inertia_kgm2[{i}][{j}]", _real(value)) for j, value in enumerate(row))
    for i, value in enumerate(satellite.body.residual_dipole_Am2.tolist()):
        yield f"residual_dipole_Am2[{i}]", _real(value)
    names = settings.sensors.sensors.split("+")
    for i, sensor in enumerate(SENSORS):
        yield f"uses[{i}]", str(sensor in names).lower()
    yield "step_s", repr(board.step_s)
    yield "longest_gap_s", repr(min(board.longest_gap_s, 1e14))
    singles = {
        "sigma_star": satellite.star_tracker.sigma_rad,
        "sigma_gyro_rad_s": satellite.gyro.sigma_rad_s,
        "sigma_field_T": satellite.magnetometer.sigma_T,
        "sigma_sun": satellite.sun_sensor.sigma_rad,
        "field_error_T": settings.field_error_T,
        "gyro_walk_rad_s": satellite.gyro.bias_walk_rad_s,
        "field_walk_T": satellite.magnetometer.bias_walk_T,
        "noise_attitude": noise["attitude"],
        "noise_rate_rad_s": noise["rate_rad_s"],
        "axes_sigma_rad": settings.field_axes_sigma_rad,
    }
    yield from ((place, _real(value)) for place, value in singles.items())
    added = ["field_bias_T", "gyro_bias_rad_s", "disturbance_s2", "", "dipole_Am2", "field_gain"]
    start = [
        settings.field_bias_sigma_T,
        settings.gyro_bias_sigma_rad_s,
        settings.disturbance_sigma_s2,
        settings.field_model_sigma_T,
        settings.dipole_sigma_Am2,
        settings.field_gain_sigma,
    ]
    lasts = {"field-model": settings.field_correlation_s, "disturbance": settings.disturbance_correlation_s}
    for i, state in enumerate(STATES):
        yield f"noise[{i}]", _real(noise[added[i]] if added[i] else 0.0)
        yield f"start_sigma[{i}]", _real(start[i])
        yield f"lasts_s[{i}]", _real(lasts[state] if math.isfinite(lasts.get(state, math.inf)) else 0.0)
    yield "gate_limit", repr(min(settings.gate_limit, 1e300))


def _real(value: float) -> str:
    return f"Real({float(value)!r})"
