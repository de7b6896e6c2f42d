"""``magloc export-config``: an array, or the filter of a satellite, as a C++ header for a microcontroller."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import arrays
from arrays.io.errors import naming
from arrays.io.outputs import refuse_unwritable
from arrays.io.text import write_text
from magloc.cli.framework import QuietOptions, note

if TYPE_CHECKING:
    from collections.abc import Iterable

    from arrays.array import SensorArray


def export_config(
    array: Path,
    /,
    *,
    to: Literal["header"] = "header",
    out: Path | None = None,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen; the framework reads it
) -> None:
    """Write the sensors of an array, or the filter of a satellite, as a C++ header.

    The header of an array has positions, gains, offsets and noise, and needs no other file. That of a satellite has
    inertia, sensors, noise and states, for ``adcs/satellite_filter.hpp``. Units are SI.

    Parameters
    ----------
    array : Path
        Array file (TOML), or scenario of a satellite (TOML, or the name of a built-in one).
    to : str
        Format: a C++ header.
    out : Path, optional
        File to write; by default the header is printed.
    common : QuietOptions
        Common options.
    """
    refuse_unwritable(out, "--out", ".hpp")
    header = _satellite_header(str(array)) if _is_satellite(array) else array_header(arrays.read_array(array))
    if out is None:
        print(header, end="")
        return
    write_text(header, out)
    note(f"wrote {out}")


# adcs stands above this package, so it is imported by name, and only for a satellite.
def _is_satellite(file: Path) -> bool:
    """Return whether a file is the scenario of a satellite."""
    if not file.suffix:
        return str(file) in import_module("adcs.io.scenario_files").built_in_scenarios()
    from arrays.io.toml import read_toml

    return "satellite" in read_toml(file, "an array, or the scenario of a satellite")


def _satellite_header(scenario: str) -> str:
    """Return a C++ header with the filter of a satellite."""
    file = import_module("adcs.io.scenario_files").read_scenario(scenario)
    with naming(scenario):
        board = import_module("adcs").SatelliteFilter(file.satellite, sensors=file.estimator(), step_s=file.step_s)
        return str(import_module("adcs.kalman.config_header").satellite_header(file.name, board))


def array_header(array: SensorArray) -> str:
    """Return a C++ header with the numbers of an array."""
    name = "".join(char for char in array.name if char.isprintable() and char not in "\\?") or "without a name"
    n = array.n_channels
    gain, position = array.channel_gain.tolist(), [list(sensor.position_m) for sensor in array.sensors]
    lines = [
        f"// Sensor array, {name}: written by magloc export-config. SI units, axes of the array.",
        "#pragma once",
        "namespace sensor_array {",
        f"constexpr int n_sensors = {array.n_sensors}, n_channels = {n};",
        f"constexpr double position_m[n_sensors][3] = {_rows(position)};",
        "// A reading is gain . field + offset_T; of a scalar channel it is gain[0] times the modulus, + offset_T.",
        f"constexpr int sensor[n_channels] = {_row(array.channel_sensor.tolist())};",
        f"constexpr bool is_scalar[n_channels] = {_row(map(int, array.channel_is_scalar.tolist()))};",
        f"constexpr double gain[n_channels][3] = {_rows(gain)};",
        f"constexpr double offset_T[n_channels] = {_row(array.channel_offset_T.tolist())};",
        f"constexpr double noise_T[n_channels] = {_row(array.channel_noise_T.tolist())};",
        "}  // namespace sensor_array",
    ]
    return "\n".join(lines) + "\n"


def _row(values: Iterable[float]) -> str:
    return f"{{{', '.join(map(repr, values))}}}"


def _rows(rows: Iterable[Iterable[float]]) -> str:
    return "{\n    " + ",\n    ".join(map(_row, rows)) + "}"
