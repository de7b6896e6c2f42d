"""Files of a simulation: readings, truth and array."""

from __future__ import annotations

import os
import tempfile
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from arrays.array_file import write_array
from arrays.io.csv import write_columns
from arrays.io.errors import InputError
from arrays.io.text import write_text
from magloc.readings import write_readings
from magloc.signature.path import write_object_path
from magloc.truth import TRUE_MOMENT_COLUMNS, TRUE_POSITION_COLUMNS, TRUE_ROTATION_COLUMNS, Truth
from sims.magnetics.simulation import Simulation

_TARGET_COLUMNS = (*TRUE_POSITION_COLUMNS, *TRUE_MOMENT_COLUMNS)


class SimulationFiles(NamedTuple):
    """Paths of the files of a simulation.

    Attributes
    ----------
    truths, paths : tuple of Path
        One for each source.
    targets : tuple of Path
        One for all targets in the ground, if there are any.
    """

    readings: Path
    array: Path
    truths: tuple[Path, ...]
    paths: tuple[Path, ...]
    targets: tuple[Path, ...] = ()

    @property
    def all(self) -> tuple[Path, ...]:
        """All files."""
        return (self.readings, self.array, *self.truths, *self.paths, *self.targets)


def files_beside(readings: str | PathLike[str], n_sources: int, *, has_targets: bool = False) -> SimulationFiles:
    """Return the paths of a simulation's files, given the path of the readings.

    Returns: READINGS-array.toml, READINGS-truth.csv, READINGS-truth-2.csv and so on beside READINGS.csv, and the same
    of READINGS-path.csv; READINGS-targets.csv if there are targets in the ground.
    """
    path = Path(readings)
    numbers = ["", *(f"-{number}" for number in range(2, n_sources + 1))][:n_sources]
    truths, paths = (
        tuple(path.with_name(f"{path.stem}-{name}{number}.csv") for number in numbers) for name in ("truth", "path")
    )
    targets = (path.with_name(f"{path.stem}-targets.csv"),) if has_targets else ()
    return SimulationFiles(path, path.with_name(f"{path.stem}-array.toml"), truths, paths, targets)


def write_simulation(simulation: Simulation, readings: str | PathLike[str]) -> SimulationFiles:
    """Write the files of a simulation; they appear when all of them are complete.

    Parameters
    ----------
    simulation : Simulation
        Simulation from :func:`sims.simulate`.
    readings : path-like
        Path of the readings file; the others are written beside it (:func:`files_beside`). Existing files are replaced.

    Returns
    -------
    SimulationFiles
        Paths of the files that were written.

    Raises
    ------
    InputError
        There is no such folder, or a folder stands where a file should.
    OSError
        The files cannot be written.

    Examples
    --------
    >>> import sims
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("weaving"), duration_s=5.0)
    >>> simulation = sims.simulate(scenario, rng=0)
    >>> sims.write_simulation(simulation, "weaving.csv").array.name
    'weaving-array.toml'
    """
    files = files_beside(readings, len(simulation.truths), has_targets=simulation.scenario.targets is not None)
    folder = files.readings.absolute().parent
    if not folder.is_dir():
        raise InputError(f"{readings}: found no folder {folder}, expected one.")
    for path in files.all:
        if path.exists() and not path.is_file():
            found = "directory" if path.is_dir() else "device or a pipe"
            raise InputError(f"{path} is a {found}, expected a file that can be written.")
    with tempfile.TemporaryDirectory(dir=folder, prefix=".magloc-") as name:
        hidden = Path(name)
        write_readings(hidden / files.readings.name, simulation.readings, simulation.array)
        write_array(hidden / files.array.name, simulation.array)
        for path, truth in zip(files.truths, simulation.truths, strict=True):
            write_truth(truth, hidden / path.name)
        for path, known in zip(files.paths, simulation.paths, strict=True):
            write_object_path(hidden / path.name, known)
        for path in files.targets:
            buried = np.hstack([simulation.target_position_m, simulation.target_moment_Am2])
            write_columns(dict(zip(_TARGET_COLUMNS, buried.T, strict=True)), hidden / path.name)
        for path in files.all:
            os.replace(hidden / path.name, path)
    return files


def write_truth(truth: Truth, path: str | PathLike[str]) -> None:
    """Write a truth file, with exact numbers."""
    header = ["time_s", *TRUE_POSITION_COLUMNS]
    columns = [truth.time_s[:, None], truth.position_m]
    if truth.moment_Am2 is not None:
        header += TRUE_MOMENT_COLUMNS
        columns.append(truth.moment_Am2)
    if truth.rotation is not None:
        header += TRUE_ROTATION_COLUMNS
        columns.append(truth.rotation.as_quat())
    for name, sigma in (("sigma_m", truth.sigma_m), ("sigma_deg", truth.sigma_rad)):
        if sigma is not None:
            header.append(name)
            columns.append(sigma[:, None] if name == "sigma_m" else np.degrees(sigma)[:, None])
    rows = (",".join(map(repr, row)) for row in np.hstack(columns).tolist())
    write_text("\n".join([",".join(header), *rows, ""]), path)
