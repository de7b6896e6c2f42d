"""``magloc map``: convergence map of a filter over starts, or of fixes over sources."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import magloc
from arrays.io.errors import InputError, naming, naming_options
from arrays.io.outputs import refuse_file
from arrays.io.text import write_netcdf
from magloc.cli.framework import CommonOptions, Flag, note, print_result, progress
from magloc.cli.options import Grid

if TYPE_CHECKING:
    from collections.abc import Callable

    import xarray as xr

    from magloc.convergence.over_sources import SourcesSummary
    from magloc.convergence.over_starts import StartsSummary
    from magloc.grids.cube import Summary


Over = Literal["starts", "sources"]
Device = Literal["cpu", "cuda"]


def map_(
    scenario: str | None = None,
    /,
    *,
    over: Over = "starts",
    method: str | None = None,
    device: Device = "cpu",
    grid: Grid | None = None,
    noise: Flag = False,
    body_length_m: float | None = None,
    scheduler: str | None = None,
    out: Path | None = None,
    netcdf: Flag = False,
    json: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Compute a convergence map: of a filter over a cube of starts, or of fixes over a cube of sources.

    Writes map.zarr chunk by chunk, and convergence.png (three slices). The same command continues an interrupted map.

    Parameters
    ----------
    scenario : str
        Built-in scenario or scenario file (TOML). By default "paper" over starts, the figure of the source paper, and
        "wide" over sources, with an array wide enough to determine the range.
    over : str
        starts: one source, and a filter from every start. sources: many sources with random moments and noise, located
        once each, without a start.
    method : str
        Filter over starts: repeated, iekf, damped or global; by default that of the scenario.
    device : str
        cpu, the only one. The next release removes this option.
    grid : int
        Number of points along every axis; by default 41 starts, 21 sources.
    noise : bool
        Over starts: add noise of the sensors, drawn with --seed, to the noise-free readings.
    body_length_m : float
        Over sources: length of every source [m], instead of the scenario's. The part of its field that a dipole does
        not describe counts as noise. By default a quarter of its distance near the array. 0 for point sources.
    scheduler : str
        Address of a dask scheduler (tcp://HOST:PORT), whose workers then compute the map.
    out : Path
        Folder to write; by default map-SCENARIO-METHOD-GRID.
    netcdf : bool
        Also write convergence.nc, the whole map; it has to fit into memory.
    json : bool
        Print one JSON object with the counts.
    common : CommonOptions
        Common options.
    """
    from magloc.grids.store import chunk_seconds

    if device != "cpu":
        raise InputError(f"--device: found {device}, expected cpu: filters no longer run on graphics processors.")
    n = (41 if over == "starts" else 21) if grid is None else grid
    scenario = scenario or ("paper" if over == "starts" else "wide")
    if over == "starts":
        if body_length_m is not None:
            raise InputError(f"--body-length-m: found {body_length_m:g}, expected none with --over starts.")
        name, compute = _over_starts(scenario, method, common.seed if noise else None)
    else:
        name, compute = over, _over_sources(scenario, method, common.seed, body_length_m)
    drawn = f"-seed{common.seed}" if noise or (over == "sources" and common.seed) else ""
    folder = Path(f"map-{Path(scenario).stem}-{name}-{n}{drawn}") if out is None else out
    store = folder / "map.zarr"
    refuse_file(folder, "--out")
    before = chunk_seconds(store)
    with (
        naming(scenario),
        naming_options("scheduler"),
        progress(n**3, over) as advance,
    ):
        dataset = compute(n=n, out=store, scheduler=scheduler, progress=advance)
    done = chunk_seconds(store)
    with dataset:
        counts = _summary(dataset)
        draw = magloc.plots.convergence if over == "starts" else magloc.plots.sources
        magloc.plots.write(draw(dataset), folder / "convergence.png")
        if netcdf:
            write_netcdf(dataset, folder / "convergence.nc")
    print_result({**_KEYS, **asdict(counts), "out": str(folder)}, counts.lines(), as_json=json)
    if not json:
        note(_how_done(int((before == done).sum()) if before.size else 0, done.size, counts, folder))


# Keys of every map, in this order; null where a map has no such number.
_KEYS = dict.fromkeys(
    (
        "starts",
        "converged",
        "fraction",
        "front_fraction",
        "back_fraction",
        "front_within_13m_fraction",
        "beyond_20m_fraction",
        "median_iterations",
        "iterations_total",
    )
)


def _over_starts(scenario: str, method: str | None, noise_seed: int | None) -> tuple[str, Callable[..., xr.Dataset]]:
    """Return the name of the method, and the function of the map without the common arguments."""
    import numpy as np

    from magloc.convergence.filters import FILTERS
    from magloc.convergence.scenario_files import read_starts_scenario

    if method is not None and method not in FILTERS:
        raise InputError(f"--method: found {method!r}, expected one of {', '.join(FILTERS)}.")
    task = read_starts_scenario(scenario, method=method, noise_seed=noise_seed)
    source = magloc.Source(np.asarray(task.position_m), np.asarray(task.moment_Am2))
    options: dict[str, Any] = {"method": task.method, "edge_m": 2.0 * task.half_width_m, "noise_seed": noise_seed}
    return task.method.name, partial(magloc.convergence_map, task.array, source, **options)


def _over_sources(
    scenario: str, method: str | None, seed: int, body_length_m: float | None
) -> Callable[..., xr.Dataset]:
    from magloc.convergence.scenario_files import read_sources_scenario

    if method not in (None, "global"):
        raise InputError(f"--method: found {method!r}, expected global or none: sources are fixed without a start.")
    task = read_sources_scenario(scenario, seed=seed)
    if body_length_m is not None:
        with naming_options("body_length_m"):
            task = replace(task, body_length_m=body_length_m)
    return partial(
        magloc.source_map,
        task.array,
        task.moment_Am2,
        edge_m=2.0 * task.half_width_m,
        nearest_m=task.nearest_m,
        farthest_m=task.farthest_m,
        rng=seed,
        known_moment_sigma_Am2=task.known_moment_sigma_Am2,
        body_length_m=task.body_length_m,
    )


def _summary(dataset: xr.Dataset) -> StartsSummary | SourcesSummary:
    from magloc.convergence import over_sources, over_starts

    return over_starts.summary(dataset) if "half" in dataset else over_sources.summary(dataset)


def _how_done(before: int, n_chunks: int, counts: Summary, folder: Path) -> str:
    per_iteration_us = 1e6 * counts.seconds / max(1, counts.iterations_total)
    text = f"{counts.iterations_total} iterations in {counts.seconds:.2f} s ({per_iteration_us:.3g} µs each)"
    if before == n_chunks:
        return f"{folder}/ was complete, nothing was computed again; {text}"
    return f"{text}; wrote {folder}/" + (f", {before} of {n_chunks} chunks were there before" if before else "")
