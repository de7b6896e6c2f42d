"""``magloc bounds``: how well can an array know a source, wherever it is?"""

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
# In circumradii of the array: the least distance of a source from a sensor and from the centroid, and of a sphere.
_LEAST_DISTANCE = 1e-4
_REACH = (1e-4, 1e6)
_SLICE_GRID = 121
_STEP_DEG = 5.0
_FRAMES = 24


@Parameter(name="*", group="Array and source")
@dataclass(frozen=True)
class SourceOptions:
    """What stands in place of the scenario's.

    Parameters
    ----------
    array : Path
        Array file (TOML), in place of the scenario's array.
    position : tuple of 3 floats
        Where the source is [m], in the array's frame, in place of the scenario's position.
    moment_Am2 : tuple of 3 floats
        Its moment [A·m²], in place of the scenario's.
    ambient_uncertainty_nT : float
        Standard deviation per axis of the ambient field that the array file states, for scalar sensors [nT].
    known_moment_sigma_Am2 : float
        Standard deviation of what is known beforehand of the moment's modulus [A·m²]. Nothing is by default.
    body_length_m : float
        Length of the source: what a dipole leaves out of its field counts as noise. By default a quarter of its
        distance, where four sensors are nearer than 0.6 of the array's circumradius; 0 for a point.
    """

    array: Path | None = None
    position: Vector | None = None
    moment_Am2: Annotated[Vector | None, Parameter(name="--moment-Am2")] = None
    ambient_uncertainty_nT: Annotated[float, Parameter(name="--ambient-uncertainty-nT")] = 0.0
    known_moment_sigma_Am2: Annotated[float | None, Parameter(name="--known-moment-sigma-Am2")] = None
    body_length_m: float | None = None


@Parameter(name="*", group="What is required, and where")
@dataclass(frozen=True)
class TaskOptions:
    """What the maps are to show.

    Parameters
    ----------
    range_m : float
        Distance from the sensors' centroid [m] for the picture of a sphere; by default that of the source.
    accuracy_m : float
        Required standard deviation of the range [m].
    half_width_m : float
        The cube and the slices reach so far from the centroid [m]; by default twice the range.
    probability : float
        Of detection, for the distances at which a source is found.
    false_alarm_rate : float
        Share of the rows without a source in which one may be found, 0.0001 or more.
    moments : int
        Directions of the moment, 10,000 at most.
    grid : int
        Points along every axis of the cube, 2,000 at most.
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
    """Tell how well an array can know a source at best (Cramér-Rao bounds), and how far it reaches.

    Prints the bounds of the scenario's source, how far away the range is known as well as required, and how far away
    the matched filter finds a source at all. Writes map.zarr (a cube of sources), slices.nc and spheres.nc, and
    pictures: bounds-slices.png, bounds-sphere.png, bounds-reach.png. All bounds come for the given moment, and over
    moments of its size in all directions. The same command continues a map that was interrupted.

    Parameters
    ----------
    scenario : str
        Built-in scenario or scenario file (TOML) of magloc map, for its array and source: "wide", or "paper", that of
        Pavlov, Karshakov and Goldin.
    of : SourceOptions
        Array and source.
    task : TaskOptions
        What is required, and where.
    gif : bool
        Write bounds.gif as well: the sphere, from half to twice the range.
    out : Path
        Folder to write; by default bounds-SCENARIO-GRID, or bounds-ARRAY-GRID, and the moment if one is given.
    json : bool
        Print one JSON object: "position_m", "moment_Am2", "range_m"; "body_length_m" that is taken, 0 of a point,
        where it is not; "rank" of the information, 6 if everything is
        estimable; "sigma_position_m", "sigma_moment_Am2" (three numbers), "sigma_range_m", "sigma_bearing_deg" (null:
        infinite); "over_moments": "sigma_range_m" and "sigma_bearing_deg" with "mean", "median", "q95",
        "worst_sampled" for the same position; "accuracy_m"; "accuracy_range_m": for "moment", "median", "q95",
        "worst_sampled" the "least", "median" and "greatest" over all directions; "detection": "probability",
        "false_alarm_rate", "threshold" of the matched filter and its "threshold_error", null without one;
        "detection_range_m" in the form of "accuracy_range_m"; "grid", "moments", "points",
        "accurate_fraction" of the cube (95 % of the moments), "seconds" of the cube alone, "out".
    common : CommonOptions
        Common options. The seed is that of the noise which sets the threshold of detection; no bound depends on it.
    """
    import numpy as np

    from magloc.bounds.over_moments import bounds_over_moments
    from magloc.bounds.report import BoundsReport
    from magloc.convergence.scenario_files import read_starts_scenario
    from magloc.fields.multipole import assumed_body_lengths
    from magloc.measurement.rows import check_magnitudes

    source = read_starts_scenario(scenario)
    array = source.array if of.array is None else _array_of(of.array)
    with naming(scenario if of.array is None else str(of.array)):
        check_magnitudes(array)
    place = np.asarray(source.position_m if of.position is None else of.position)
    radius = _checked(array, place, of, task)
    wanted = _scenario(array, source.moment_Am2 if of.moment_Am2 is None else of.moment_Am2, radius, of, task)
    if array.channel_is_scalar.any() and array.ambient_T is None:
        note("warning: the array has scalar sensors and no ambient_nT: the ambient field counts as 0", always=True)
    length_m = float(assumed_body_lengths(array.positions, place, array.circumradius, wanted.body_length_m))
    if wanted.body_length_m is None and length_m:
        note(
            f"note: the source is so near that its size matters: a quarter of its distance, {length_m:.3g} m, is taken;"
            " --body-length-m says it, 0 a point",
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


def _checked(array: SensorArray, place: FloatArray, of: SourceOptions, task: TaskOptions) -> float:
    """Radius of the sphere, once the options are known to be in bounds."""
    import numpy as np

    from magloc.bounds.report import plain_vector

    refuse_not_positive(task, "range_m", "half_width_m", "accuracy_m", expected="a positive length")
    if not 1e-4 <= task.false_alarm_rate < 0.5:
        raise InputError(
            f"--false-alarm-rate: found {task.false_alarm_rate:g}, expected 0.0001 or more, and less than 0.5."
        )
    if not task.false_alarm_rate < task.probability < 1.0:
        raise InputError(f"--probability: found {task.probability:g}, expected it between the false-alarm rate and 1.")
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
    """Refuse a source in a sensor, at the centroid, where range and bearing are none, and beyond all reach."""
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
    array = array_of_several(path, "which knows no place: magloc locate --position tells the moment at a known one")
    # A figure calls an array by its name; one without is called after its file.
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
    """Matched filter of the array; None, with a note, where it has none."""
    try:
        return magloc.MatchedFilterDetector.of(array, false_alarm_rate, n_draws=round(100 / false_alarm_rate), rng=seed)
    except ValueError as error:
        note(f"how far a source is found is left out: {own_sentence(error)}", always=True)
        return None


def _cube(task: BoundScenario, grid: int, folder: Path) -> BoundsSummary:
    """Counts of the cube, computed as far as it is not done."""
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
    """Slices and spheres, as data and as figures; returns the spheres."""
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
