"""``magloc bounds``: Cramér-Rao bounds of a source, and the reach of an array."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from cyclopts.validators import Number

import magloc
from arrays.io.errors import LARGEST, InputError, naming, naming_options, own_sentence
from arrays.io.outputs import refuse_file, write_file
from arrays.typing import Vector
from magloc.cli.framework import (
    CommonOptions,
    Flag,
    note,
    print_result,
    progress,
    refuse_outside,
    whole_number,
)
from magloc.cli.options import Grid, array_of_several, refuse_not_positive

if TYPE_CHECKING:
    import xarray as xr

    from arrays.array import SensorArray
    from arrays.typing import FloatArray
    from magloc.bounds.maps import BoundScenario, BoundsSummary
    from magloc.detection.matched_filter import MatchedFilterDetector


Directions = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=1, lte=10_000))]
_LARGEST_AM2 = 1e12
# In circumradii: the least distance of a source from a sensor and from the centroid, and the limits of a sphere.
_LEAST_DISTANCE = 1e-4
_REACH = (1e-4, 1e6)
_SLICE_GRID = 121
_STEP_DEG = 5.0
_FRAMES = 24


@Parameter(name="*", group="Array and source")
@dataclass(frozen=True)
class SourceOptions:
    """Array and source, instead of those of the scenario.

    Parameters
    ----------
    array : Path
        Array file (TOML), instead of the scenario's array.
    position : tuple of 3 floats
        Position of the source [m], in the array's frame, instead of the scenario's.
    moment_Am2 : tuple of 3 floats
        Moment of the source [A·m²], instead of the scenario's.
    ambient_uncertainty_nT : float
        Standard deviation per axis [nT] of the ambient field in the array file. It matters for scalar sensors.
    known_moment_sigma_Am2 : float
        Standard deviation of a modulus of the moment that is known [A·m²]. By default the modulus is unknown.
    body_length_m : float
        Length of the source [m]. The part of its field that a dipole does not describe counts as noise. By default a
        quarter of its distance, if four sensors are nearer than 0.6 of the array's circumradius. 0 for a point source.
    body : Path
        Body file (TOML) of a rigid body of two or more magnets: bounds of its pose over the limits of the file; needs
        --array, and no maps are written.
    """

    array: Path | None = None
    position: Vector | None = None
    moment_Am2: Annotated[Vector | None, Parameter(name="--moment-Am2")] = None
    ambient_uncertainty_nT: Annotated[float, Parameter(name="--ambient-uncertainty-nT")] = 0.0
    known_moment_sigma_Am2: Annotated[float | None, Parameter(name="--known-moment-sigma-Am2")] = None
    body_length_m: float | None = None
    body: Path | None = None


@Parameter(name="*", group="Required accuracy, and extent of the maps")
@dataclass(frozen=True)
class TaskOptions:
    """Required accuracy, and the extent of the maps.

    Parameters
    ----------
    range_m : float
        Radius of the sphere that is drawn, about the sensors' centroid [m]; by default the distance of the source.
    accuracy_m : float
        Required standard deviation of the range [m].
    half_width_m : float
        Half the edge of the cube and of the slices [m]; by default twice --range-m.
    probability : float
        Required probability of detection, for the detection range.
    false_alarm_rate : float
        Allowed share of false alarms in rows without a source, at least 0.0001.
    moments : int
        Number of directions of the moment, at most 10,000.
    grid : int
        Number of points along every axis of the cube, at most 2,000.
    """

    range_m: float | None = None
    accuracy_m: float = 0.5
    half_width_m: float | None = None
    probability: float = 0.9
    false_alarm_rate: float = 1e-3
    moments: Directions = 50
    grid: Grid = 41


def bounds(
    scenario: str = "wide",
    /,
    *,
    of: SourceOptions = SourceOptions(),
    task: TaskOptions = TaskOptions(),
    gif: Flag = False,
    out: Path | None = None,
    json: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Compute Cramér-Rao bounds of a source, and how far an array reaches.

    Prints the bounds of the scenario's source, the distance up to which the range is as accurate as required, and the
    distance up to which the matched filter detects a source. All bounds are for the given moment, and over moments of
    its size in all directions. Writes map.zarr (a cube of sources), slices.nc, spheres.nc, and the pictures
    bounds-slices.png, bounds-sphere.png and bounds-reach.png. The same command continues an interrupted map.

    Parameters
    ----------
    scenario : str
        Built-in scenario or scenario file (TOML) of magloc map; its array and its source are used. Built in are "wide"
        and "paper", the scenario of Pavlov, Karshakov and Goldin.
    of : SourceOptions
        Array and source.
    task : TaskOptions
        Required accuracy, and extent of the maps.
    gif : bool
        Also write bounds.gif: the sphere, from half to twice its radius.
    out : Path
        Folder to write; by default bounds-SCENARIO-GRID, or bounds-ARRAY-GRID, with the moment if one is given.
    json : bool
        Print one JSON object: "position_m", "moment_Am2", "range_m"; "body_length_m", which is omitted for a point
        source; "rank" of the information, 6 if everything is estimable; "sigma_position_m", "sigma_moment_Am2" (three
        numbers), "sigma_range_m", "sigma_bearing_deg" (null: infinite); "over_moments": "sigma_range_m" and
        "sigma_bearing_deg" with "mean", "median", "q95", "worst_sampled" for the same position; "accuracy_m";
        "accuracy_range_m": for "moment", "median", "q95", "worst_sampled" the "least", "median" and "greatest" over all
        directions; "detection": "probability", "false_alarm_rate", "threshold" of the matched filter and its
        "threshold_error", null without one; "detection_range_m" in the form of "accuracy_range_m"; "grid", "moments",
        "points", "accurate_fraction" of the cube (95 % of the moments), "seconds" of the cube alone, "out".
    common : CommonOptions
        Common options. The seed only affects the threshold of detection, which simulated noise sets.
    """
    import numpy as np

    from magloc.bounds.over_moments import bounds_over_moments
    from magloc.bounds.report import BoundsReport
    from magloc.convergence.scenario_files import read_starts_scenario
    from magloc.fields.multipole import assumed_body_lengths
    from magloc.measurement.rows import check_magnitudes

    if of.body is not None:
        from magloc.cli.moments.body_poses import bounds_with_body, refuse_with_body

        refuse_with_body({"--position": of.position, "--moment-Am2": of.moment_Am2, "--out": out, "--gif": gif})
        if of.array is None:
            raise InputError("--body: found no --array, expected the array file.")
        bounds_with_body(of.array, of.body, as_json=json)
        return
    source = read_starts_scenario(scenario)
    array = source.array if of.array is None else _array_of(of.array)
    with naming(scenario if of.array is None else str(of.array)):
        check_magnitudes(array)
    place = np.asarray(source.position_m if of.position is None else of.position)
    radius = _check_options(array, place, of, task)
    wanted = _scenario(array, source.moment_Am2 if of.moment_Am2 is None else of.moment_Am2, radius, of, task)
    if array.channel_is_scalar.any() and array.ambient_T is None:
        note("warning: the array has scalar sensors and no ambient_nT: the ambient field counts as 0", always=True)
    length_m = float(assumed_body_lengths(array.positions, place, array.circumradius, wanted.body_length_m))
    if wanted.body_length_m is None and length_m:
        note(
            f"note: so near, the size of the source matters: {length_m:.3g} m, a quarter of its distance, are"
            " assumed; set --body-length-m, 0 for a point source",
            always=True,
        )
    of_source = magloc.cramer_rao_bounds(array, place, wanted.moment_Am2, **wanted.uncertainties)
    over_moments = bounds_over_moments(array, place[None], wanted.moments_Am2, **wanted.uncertainties)
    name = Path(scenario).stem if of.array is None else of.array.stem
    moment = "" if of.moment_Am2 is None else "-" + "_".join(f"{value:g}" for value in of.moment_Am2)
    folder = Path(f"bounds-{name}-{task.grid}{moment}") if out is None else out
    refuse_file(folder, "--out")
    detector = _detector(array, task.false_alarm_rate, common.seed)
    counts = _cube(wanted, task.grid, folder)
    spheres = _pictures(wanted, detector, task.probability, radius, folder, gif=gif)
    result = BoundsReport(of_source, over_moments, spheres, wanted, length_m, detector)
    of_cube: dict[str, Any] = {"grid": task.grid, "moments": task.moments, "points": counts.points}
    of_cube |= {"accurate_fraction": counts.fraction, "seconds": counts.seconds, "out": str(folder)}
    print_result(result.json() | of_cube, result.lines(), as_json=json)
    if not json:
        note(f"{counts.points} sources × {task.moments + 1} moments in {counts.seconds:.2f} s; wrote {folder}/")


def _check_options(array: SensorArray, place: FloatArray, of: SourceOptions, task: TaskOptions) -> float:
    """Check the options, and return the radius of the sphere."""
    import numpy as np

    from magloc.bounds.report import plain_vector

    refuse_not_positive(task, "range_m", "half_width_m", "accuracy_m", expected="a positive length")
    if not 1e-4 <= task.false_alarm_rate < 0.5:
        raise InputError(
            f"--false-alarm-rate: found {task.false_alarm_rate:g}, expected 0.0001 or more, and less than 0.5."
        )
    if not task.false_alarm_rate < task.probability < 1.0:
        raise InputError(
            f"--probability: found {task.probability:g}, expected more than the false-alarm rate and less than 1."
        )
    refuse_outside(0.0, LARGEST, "zero or more", ambient_uncertainty_nT=of.ambient_uncertainty_nT)
    refuse_not_positive(of, "known_moment_sigma_Am2")
    _check_place(array, place)
    radius = float(np.linalg.norm(place - array.centroid)) if task.range_m is None else task.range_m
    nearest_m, farthest_m = (factor * array.circumradius for factor in _REACH)
    if not nearest_m <= radius <= farthest_m:
        raise InputError(
            f"--range-m: found {radius:g}, expected {nearest_m:.3g} to {farthest_m:.3g} m, by the size of the array."
        )
    if of.moment_Am2 is not None and not 0.0 < max(map(abs, of.moment_Am2)) <= _LARGEST_AM2:
        raise InputError(
            f"--moment-Am2: found {plain_vector(of.moment_Am2)}, expected three finite numbers, not all zero, up to "
            f"{_LARGEST_AM2:g} A·m²."
        )
    return radius


def _check_place(array: SensorArray, place: FloatArray) -> None:
    """Refuse a source in a sensor, at the centroid or beyond all reach."""
    import numpy as np

    from magloc.bounds.report import plain_vector

    found = f"--position: found {plain_vector(place)}"
    if not np.isfinite(place).all():
        raise InputError(f"{found}, expected three finite numbers.")
    if not np.abs(place - array.centroid).max() <= _REACH[1] * array.circumradius:
        raise InputError(f"{found}, expected a place within {_REACH[1] * array.circumradius:.3g} m.")
    least_m = _LEAST_DISTANCE * array.circumradius
    if np.linalg.norm(place - array.centroid) < least_m:
        raise InputError(f"{found}, the sensors' centroid, expected a place away from it.")
    distances = np.linalg.norm(place - array.positions, axis=1)
    if distances.min() < least_m:
        sensor = array.sensors[int(distances.argmin())].id
        raise InputError(f"{found}, at sensor {sensor}, expected a place away from it.")


def _array_of(path: Path) -> SensorArray:
    array = array_of_several(
        path, "which cannot locate a source: magloc locate --position gives its moment at a known place"
    )
    # Figures show the name of an array.
    return array if array.name else replace(array, name=path.stem)


def _scenario(
    array: SensorArray, moment_Am2: Vector, radius: float, of: SourceOptions, task: TaskOptions
) -> BoundScenario:
    from magloc.bounds.maps import BoundScenario

    with naming("--moment-Am2"), naming_options("body_length_m"):
        return BoundScenario(
            array,
            moment_Am2,
            half_width_m=2.0 * radius if task.half_width_m is None else task.half_width_m,
            accuracy_m=task.accuracy_m,
            n_moments=task.moments,
            ambient_uncertainty_T=1e-9 * of.ambient_uncertainty_nT,
            known_moment_sigma_Am2=math.inf if of.known_moment_sigma_Am2 is None else of.known_moment_sigma_Am2,
            body_length_m=of.body_length_m,
        )


def _detector(array: SensorArray, false_alarm_rate: float, seed: int) -> MatchedFilterDetector | None:
    """Return the matched filter of the array; None, with a note, if it has none."""
    try:
        return magloc.MatchedFilterDetector.of(array, false_alarm_rate, n_draws=round(100 / false_alarm_rate), rng=seed)
    except ValueError as error:
        note(f"no detection range: {own_sentence(error)}", always=True)
        return None


def _cube(task: BoundScenario, grid: int, folder: Path) -> BoundsSummary:
    """Compute the chunks of the cube that are missing, and return its counts."""
    from magloc.bounds.maps import summary

    with progress(grid**3, "sources") as advance:
        cube = magloc.bound_map(
            task.array,
            task.moment_Am2,
            edge_m=2.0 * task.half_width_m,
            n=grid,
            accuracy_m=task.accuracy_m,
            n_moments=task.n_moments,
            **task.uncertainties,
            out=folder / "map.zarr",
            progress=advance,
        )
    with cube:
        return summary(cube)


def _pictures(
    task: BoundScenario,
    detector: MatchedFilterDetector | None,
    probability: float,
    range_m: float,
    folder: Path,
    *,
    gif: bool,
) -> xr.Dataset:
    """Write slices and spheres, as data and as figures; return the spheres."""
    import numpy as np

    from magloc.bounds.maps import bound_slices
    from magloc.bounds.spheres import bound_spheres, with_detection_ranges
    from magloc.plots.bounds import write_bound_animation

    nearest = min(max(0.5 * range_m, 1.1 * task.array.circumradius), range_m)
    ranges = np.geomspace(nearest, 2.0 * range_m, _FRAMES) if gif else np.empty(0)
    slices = bound_slices(task, _SLICE_GRID)
    spheres = bound_spheres(task, np.union1d(ranges, [range_m]).tolist(), _STEP_DEG)
    if detector is not None:
        spheres = with_detection_ranges(spheres, task, detector, probability)
    files = {
        "slices.nc": slices,
        "spheres.nc": spheres,
        "bounds-slices.png": magloc.plots.bound_slices(slices, task),
        "bounds-sphere.png": magloc.plots.bound_sphere(spheres, task, range_m),
        "bounds-reach.png": magloc.plots.bound_reach(spheres, task),
    }
    for name, content in files.items():
        write_file(content, folder / name)
    if gif:
        frames = spheres.sel(range=ranges)
        with progress(_FRAMES, "pictures") as advance:
            write_bound_animation(frames, task, folder / "bounds.gif", advance)
    return spheres
