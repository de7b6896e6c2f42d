"""``magloc map``: from which starts does a filter find the source, and which sources does a fix find?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from arrays.io.arguments import Flag
from arrays.io.errors import InputError
from arrays.io.outputs import make_folder
from arrays.io.text import replace_file
from magloc.cli.framework import CommonOptions, print_json
from magloc.cli.options import Grid, complete, print_note

if TYPE_CHECKING:
    from magloc.grids.cube import CubeMap, MapSummary
    from magloc.grids.store import Sweep


Over = Literal["starts", "sources"]


def map_(
    scenario: str = "paper",
    /,
    *,
    over: Over = "starts",
    method: str | None = None,
    grid: Grid | None = None,
    noise: Flag = False,
    scheduler: str | None = None,
    out: Path | None = None,
    netcdf: Flag = False,
    json: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Draw the convergence map of a filter over a cube of starts, or that of start-free fixes over a cube of sources.

    Writes map.zarr chunk by chunk, and convergence.png (three slices). The same command continues a map that was
    interrupted.

    Parameters
    ----------
    scenario : str
        Built-in scenario or scenario file (TOML). "paper" is the figure of the source paper.
    over : str
        starts: one source, a filter from every start. sources: every source with a random moment and noise, drawn with
        --seed, fixed once without a start.
    method : str
        Filter over starts, in place of the scenario's: repeated, iekf, damped, global.
    grid : int
        Points along every axis; by default 41 starts, 21 sources.
    noise : bool
        Over starts: add one realisation of the sensors' noise, drawn with --seed, to the noise-free readings.
    scheduler : str
        Address of a dask scheduler (tcp://HOST:PORT) whose workers compute the map.
    out : Path
        Folder to write; by default map-SCENARIO-METHOD-GRID.
    netcdf : bool
        Write convergence.nc as well: the whole map, which has to fit into memory.
    json : bool
        Print one JSON object with the counts.
    common : CommonOptions
        Common options.
    """
    from dataclasses import asdict

    from magloc.grids.store import Sweep

    if over == "starts":
        cube = _starts_map(scenario, method, 41 if grid is None else grid, common.seed if noise else None)
    else:
        cube = _sources_map(scenario, method, 21 if grid is None else grid, common.seed)
    name = cube.attributes["method"] if over == "starts" else over
    drawn = f"-seed{common.seed}" if noise or (over == "sources" and common.seed) else ""
    folder = Path(f"map-{Path(scenario).stem}-{name}-{cube.grid}{drawn}") if out is None else out
    if scheduler is not None:
        from magloc.grids.cluster import check_address

        check_address(scheduler)
    make_folder(folder, "--out")
    with Sweep(cube, folder / "map.zarr") as sweep:
        for sentence in sweep.unreadable:
            print_note(sentence)
        before = sweep.chunks_done
        if before < sweep.n_chunks:
            _run(sweep, scheduler, quiet=common.quiet)
        counts = sweep.summary
    _export(folder, counts, netcdf=netcdf)
    if json:
        print_json({**asdict(counts), "out": str(folder)})
    else:
        print(_in_words(counts))
    if not (json or common.quiet):
        print_note(_how_done(before, counts, sweep, folder))


def _starts_map(scenario: str, method: str | None, grid: int, noise_seed: int | None) -> CubeMap:
    from magloc.convergence.filters import FILTERS
    from magloc.convergence.over_starts import StartsMap
    from magloc.convergence.scenario_files import read_starts_scenario

    if method is not None and method not in FILTERS:
        raise InputError(f"--method: found {method!r}, expected one of {', '.join(FILTERS)}.")
    problem = read_starts_scenario(scenario, method=method, noise_seed=noise_seed)
    try:
        return StartsMap.of(problem, grid)
    except ValueError as error:
        raise InputError(f"{scenario}: {error}") from None


def _sources_map(scenario: str, method: str | None, grid: int, seed: int) -> CubeMap:
    from magloc.convergence.over_sources import SourcesMap
    from magloc.convergence.scenario_files import read_sources_scenario

    if method not in (None, "global"):
        raise InputError(f"--method: found {method!r}, expected global or none: sources are fixed without a start.")
    problem = read_sources_scenario(scenario, seed=seed)
    try:
        return SourcesMap(problem, grid)
    except ValueError as error:
        raise InputError(f"{scenario}: {error}") from None


def _run(sweep: Sweep, scheduler: str | None, *, quiet: bool) -> None:
    """Compute what is not done yet."""
    from magloc.grids.cube import computed_here

    if scheduler is None:
        chunks = computed_here(sweep.cube, sweep.unfinished())
    else:
        from magloc.grids.cluster import computed_by

        chunks = computed_by(scheduler, sweep.cube, sweep.unfinished())
    complete(sweep, chunks, quiet=quiet)


def _export(folder: Path, counts: MapSummary, *, netcdf: bool) -> None:
    """Figure of a finished map, and all of it as netCDF if wanted."""
    from magloc.convergence.over_sources import SourceMapSummary
    from magloc.grids.store import open_map
    from magloc.plots.maps import convergence_figure, source_figure
    from magloc.plots.style import save

    with open_map(folder / "map.zarr") as dataset:
        if isinstance(counts, SourceMapSummary):
            figure = source_figure(dataset, counts)
        else:
            figure = convergence_figure(dataset, counts)
        if netcdf:
            replace_file(folder / "convergence.nc", lambda path: dataset.to_netcdf(path))
    replace_file(folder / "convergence.png", lambda path: save(figure, path))


def _how_done(before: int, counts: MapSummary, sweep: Sweep, folder: Path) -> str:
    per_iteration_us = 1e6 * counts.seconds / max(1, counts.iterations_total)
    text = f"{counts.iterations_total} iterations in {counts.seconds:.2f} s ({per_iteration_us:.3g} µs each)"
    if before == sweep.n_chunks:
        return f"{folder}/ was complete, nothing was computed again; {text}"
    return f"{text}; wrote {folder}/" + (f", {before} of {sweep.n_chunks} chunks were there before" if before else "")


def _in_words(counts: MapSummary) -> str:
    from magloc.convergence.over_sources import SourceMapSummary

    if isinstance(counts, SourceMapSummary):
        return (
            f"{counts.converged} of {counts.starts} sources found ({counts.fraction:.2%}), "
            f"truth listed {counts.truth_listed:.2%}, median {counts.median_iterations:.0f} iterations"
        )
    return (
        f"{counts.converged} of {counts.starts} starts converged ({counts.fraction:.1%}): "
        f"front half {counts.front_fraction:.1%}, back half {counts.back_fraction:.1%}, "
        f"median {counts.median_iterations:.0f} passes"
    )
