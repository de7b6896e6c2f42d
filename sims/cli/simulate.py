"""``magloc simulate``: readings of a scenario, their truth, and the array."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from arrays.io.errors import InputError, naming, naming_options
from magloc.cli.framework import CommonOptions, Flag, note, print_json


def simulate(
    scenario: str,
    /,
    *,
    out: Path,
    body_length_m: float | None = None,
    json: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Simulate the readings of an array.

    Writes READINGS.csv, and beside it READINGS-truth.csv with the position and the moment of the source in the world
    frame (READINGS-truth-2.csv and so on for more sources), READINGS-path.csv with its position and attitude,
    READINGS-targets.csv with a row for every target of a survey, and READINGS-array.toml with the array as its user
    knows it: noise of one sample, saturation, and the uncertainty of axes and gains.

    Parameters
    ----------
    scenario : str
        Scenario file (TOML), or a built-in scenario: diver, drone, hand-magnet, paper, ship, ship-headings,
        survey-cart, survey-diver, survey-drone, three-magnets or weaving.
    out : Path
        Readings file (CSV) to write. Existing files are replaced.
    body_length_m : float
        Length of every source [m], instead of the scenario's: a thin bar along the body's axis x with the moment of
        the source. 0 for a point source.
    json : bool
        Print one JSON object with the names of the files.
    common : CommonOptions
        Common options.
    """
    from arrays.io.outputs import refuse_unwritable
    from sims.magnetics.files import files_beside, write_simulation
    from sims.magnetics.scenario_files import read_scenario
    from sims.magnetics.simulation import simulate as simulated

    if not out.name:
        raise InputError(f"--out: found {out}, expected the name of a file.")
    wanted = read_scenario(scenario)
    if body_length_m is not None:
        if not wanted.sources:
            raise InputError(f"--body-length-m: found {body_length_m:g}, expected a scenario with a source.")
        with naming_options("body_length_m"):
            bodies = tuple(replace(source, body_length_m=body_length_m) for source in wanted.sources)
        wanted = replace(wanted, sources=bodies)
    for path in files_beside(out, len(wanted.sources), has_targets=wanted.targets is not None).all:
        refuse_unwritable(path, "--out")
    with naming(scenario):
        result = simulated(wanted, common.seed)
    files = write_simulation(result, out)
    if json:
        report = {
            "scenario": wanted.name,
            "seed": common.seed,
            "rows": len(result.readings),
            "channels": result.array.n_channels,
            "readings": str(files.readings),
            "array": str(files.array),
            "truths": [str(path) for path in files.truths],
            "paths": [str(path) for path in files.paths],
            "targets": [str(path) for path in files.targets],
        }
        print_json(report)
    if not json:
        listed = ", ".join(map(str, files.all))
        note(f"{len(result.readings)} rows of {result.array.n_channels} channels; wrote {listed}")
