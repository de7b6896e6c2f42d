"""``magloc new-array``: an array file from a shape and a sensor."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

import arrays
from arrays.io.errors import InputError, naming
from arrays.io.outputs import refuse_unwritable
from arrays.io.text import write_text
from magloc.cli.framework import Count, QuietOptions, note
from magloc.cli.options import refuse_not_positive

if TYPE_CHECKING:
    from arrays.array import SensorArray

_GRID = "grid"


@Parameter(name="*", group="Array")
@dataclass(frozen=True)
class ArrayOptions:
    """Shape and sensors of an array.

    Parameters
    ----------
    shape : str
        tetrahedron, square, cross, cube, hexagon, axial, or grid (a flat board).
    size_m : float
        Edge, arm, radius or baseline of the shape, or the distance between neighbours on a board [m].
    grid : tuple of 2 int
        Numbers of sensors along x and along y, for --shape grid.
    sensor : str
        rm3100, lis3mdl, tlv493d, mlx90393, fluxgate, opm or overhauser. Sets kind, noise and range from a data sheet.
    noise_nT : float
        Standard deviation of one reading, per axis [nT]; by default that of --sensor.
    kind : {"vector", "scalar"}
        Kind of the sensors without --sensor: three components, the default, or the modulus.
    rate_Hz : float
        Readings per second [Hz], for sensors whose data sheet has a noise density; 10 by default.
    """

    shape: str | None = None
    size_m: float | None = None
    grid: tuple[Count, Count] | None = None
    sensor: str | None = None
    noise_nT: Annotated[float | None, Parameter(name="--noise-nT")] = None
    kind: Literal["vector", "scalar"] | None = None
    rate_Hz: Annotated[float, Parameter(name="--rate-Hz")] = 10.0


def new_array(
    out: Path,
    /,
    *,
    wanted: ArrayOptions = ArrayOptions(),
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Write an array file from a shape, a size and a sensor.

    Without options, on a terminal, the command asks questions. The file has one table for every sensor; edit positions,
    axes and other properties there.

    Parameters
    ----------
    out : Path
        Array file (TOML) to write. An existing file is replaced.
    wanted : ArrayOptions
        Shape and sensors.
    common : QuietOptions
        Common options.
    """
    refuse_unwritable(out, "OUT", ".toml")
    if wanted == ArrayOptions() and sys.stdin.isatty():
        wanted = _ask()
    array, source = _array(wanted)
    write_text("".join(f"# {line}\n" for line in source) + arrays.array_toml(array), out)
    note(f"wrote {out}: {array.n_sensors} {array.sensors[0].kind} sensors, {array.n_channels} channels")
    for line in source:
        note(line)


def _ask() -> ArrayOptions:
    """Ask for the options on the terminal."""
    shape = _answer(f"Shape ({', '.join((*arrays.GEOMETRIES, _GRID))})", "tetrahedron")
    grid = None
    if shape == _GRID:
        n_x, n_y = (int(_number(_answer(f"Sensors along {axis}", "4"), "--grid")) for axis in "xy")
        grid = (n_x, n_y)
    size = _number(_answer("Distance of neighbours [m]" if grid else "Size [m]", "0.5"), "--size-m")
    sensor = _answer(f"Sensor ({', '.join(arrays.SENSOR_PRESETS)}, or other)", "other")
    known = arrays.SENSOR_PRESETS.get(sensor)
    kind: Literal["vector", "scalar"] | None = None
    if known is None:
        kind = "scalar" if _answer("Its readings (vector, scalar)", "vector") == "scalar" else "vector"
    noise = None
    if known is None or known.noise_of_reading_nT(1.0) is None:
        noise = _number(_answer("Noise of a reading [nT]", "1"), "--noise-nT")
    return ArrayOptions(shape, size, grid, None if sensor == "other" else sensor, noise, kind)


def _answer(question: str, default: str) -> str:
    print(f"{question} [{default}]: ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip() or default


def _number(text: str, option: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{option}: found {text!r}, expected a number.") from None


def _tesla(nanotesla: float) -> float:
    """Convert exactly as the reader of array files does."""
    return float(Decimal(repr(float(nanotesla))).scaleb(-9))


def _array(wanted: ArrayOptions) -> tuple[SensorArray, list[str]]:
    """Return the array, and the sources of its sensors' data."""
    shapes = (*arrays.GEOMETRIES, _GRID)
    if wanted.shape not in shapes:
        found = "nothing" if wanted.shape is None else repr(wanted.shape)
        raise InputError(f"--shape: found {found}, expected one of {', '.join(shapes)}.")
    if wanted.size_m is None:
        raise InputError("--size-m: found nothing, expected a length in m.")
    if (wanted.grid is not None) != (wanted.shape == _GRID):
        raise InputError("--grid: expected it, as NX NY, with --shape grid and with no other shape.")
    refuse_not_positive(wanted, "size_m", "noise_nT", "rate_Hz")
    preset = None if wanted.sensor is None else arrays.SENSOR_PRESETS.get(wanted.sensor)
    if preset is None and wanted.sensor is not None:
        raise InputError(f"--sensor: found {wanted.sensor!r}, expected one of {', '.join(arrays.SENSOR_PRESETS)}.")
    if preset is not None and wanted.kind not in (None, preset.kind):
        raise InputError(f"--kind: found {wanted.kind}, expected none: {wanted.sensor} is a {preset.kind} sensor.")
    kind = preset.kind if preset is not None else wanted.kind or "vector"
    noise_nT = wanted.noise_nT
    if noise_nT is None and preset is not None:
        noise_nT = preset.noise_of_reading_nT(wanted.rate_Hz)
    if noise_nT is None:
        why = "" if preset is None else f" ({preset.source})"
        raise InputError(f"--noise-nT: found nothing{why}, expected a positive number.")
    noise_T = _tesla(noise_nT)
    with naming("--grid" if wanted.grid else "--size-m"):
        if wanted.grid is not None:
            array = arrays.grid(*wanted.grid, wanted.size_m, kind, noise_T)
        else:
            array = arrays.GEOMETRIES[wanted.shape].make(wanted.size_m, kind, noise_T)
    if preset is None:
        return array, []
    if preset.saturation_nT is not None:
        limit_T = _tesla(preset.saturation_nT)
        array = replace(array, sensors=tuple(replace(sensor, saturation_T=limit_T) for sensor in array.sensors))
    return array, [f"{wanted.sensor}: {preset.source}"]
