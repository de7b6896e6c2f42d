"""``magloc map``: from which starts does a filter find the source?"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from arrays.errors import InputError
from magloc.commands.common import CommonOptions, Flag, print_json, print_note, progress, whole_number

Method = Literal["repeated", "iekf"]
Grid = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=2))]


def map_(
    scenario: str = "paper",
    /,
    *,
    method: Method | None = None,
    grid: Grid = 41,
    noise: Flag = False,
    out: Path | None = None,
    json: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Draw the convergence map of a filter over a cube of starts.

    Writes convergence.nc (iterations, chi-square, distance from the maximum-likelihood position, status, half) and
    convergence.png (three slices through the source).

    Parameters
    ----------
    scenario : str
        Built-in scenario or scenario file (TOML). "paper" is the figure of the source paper.
    method : str
        Filter, in place of the scenario's.
    grid : int
        Starts along every axis.
    noise : bool
        Add one realisation of the sensors' noise, drawn with --seed, to the noise-free readings.
    out : Path
        Folder to write; by default map-SCENARIO-METHOD.
    json : bool
        Print one JSON object with the counts.
    common : CommonOptions
        Common options.
    """
    from dataclasses import asdict

    from magloc.convergence import convergence_map, summary
    from magloc.plots import convergence_figure
    from magloc.scenarios import read_starts_scenario

    problem = read_starts_scenario(scenario, method=method, noise_seed=common.seed if noise else None)
    folder = Path(f"map-{Path(scenario).stem}-{problem.method.name}") if out is None else out
    _make_folder(folder)
    try:
        with progress(grid**3, "starts", quiet=common.quiet) as advance:
            dataset = convergence_map(problem, grid, advance)
    except ValueError as error:
        raise InputError(f"{scenario}: {error}") from None
    figure = convergence_figure(dataset)
    _replace(folder / "convergence.nc", lambda path: dataset.to_netcdf(path))
    _replace(folder / "convergence.png", lambda path: figure.savefig(path, format="png", dpi=150))
    counts = summary(dataset)
    if json:
        print_json({**asdict(counts), "out": str(folder)})
        return
    print(
        f"{counts.converged} of {counts.starts} starts converged ({counts.fraction:.1%}): "
        f"front half {counts.front_fraction:.1%}, back half {counts.back_fraction:.1%}, "
        f"median {counts.median_iterations:.0f} passes"
    )
    if not common.quiet:
        rate = counts.iterations_total / counts.seconds
        print_note(
            f"{counts.iterations_total} passes in {counts.seconds:.2f} s ({rate / 1e6:.1f} M/s); wrote {folder}/"
        )


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError(f"--out {folder}: found a file, expected a folder.") from None


def _replace(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file beside its final place first, so that an interruption leaves the old one or the new one."""
    unfinished = path.with_name(f".{path.name}.tmp")
    try:
        write(unfinished)
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)
