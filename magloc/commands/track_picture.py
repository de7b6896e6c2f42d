"""The pictures of a track, and the data behind them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magloc.commands.common import print_note
from magloc.output_files import Column, make_folder, write_columns
from magloc.plots import consistency_figure, save, track_figure
from magloc.plots.style import bounds99
from magloc.plots.track_figures import columns_of
from magloc.track_rows import TrackPoint

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NAMES = ("x_m", "y_m", "z_m", "mx_Am2", "my_Am2", "mz_Am2")


def write_picture(
    points: Sequence[TrackPoint],
    truth_m: FloatArray | None,
    folder: Path,
    *,
    nees: tuple[FloatArray, IntArray] | None = None,
    bound_m: FloatArray | None = None,
    array_m: FloatArray | None = None,
    quiet: bool = False,
) -> None:
    """Write track.png and consistency.png, and track.csv with the data behind both.

    Parameters
    ----------
    points : sequence of TrackPoint
    truth_m : ndarray, shape (n, 3), optional
        True positions [m], NaN where they are not known.
    folder : Path
        Made if it is not there.
    nees : tuple of ndarray, shape (n,), optional
        Normalised estimation error squared of every row, and its degrees of freedom.
    bound_m : ndarray, shape (n,), optional
        Posterior Cramér-Rao bound of the distance from the truth.
    array_m : ndarray, shape (n, 3), optional
        Origin of the array's frame in every row.
    quiet : bool
        Do not name the files on stderr.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    make_folder(folder, "--out")
    time, position, moment, covariance = columns_of(points)
    nis, nis_dof = np.array([point.nis for point in points]), np.array([point.nis_dof for point in points])
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    estimability = [np.full(6, np.nan) if point.estimability is None else point.estimability for point in points]
    state = np.concatenate([position, moment], axis=1)
    columns: dict[str, Column] = {"time_s": time}
    columns |= dict(zip(_NAMES, state.T, strict=True))
    columns |= dict(zip((f"s_{name}" for name in _NAMES), sigma.T, strict=True))
    columns |= _square("nis", nis, nis_dof)
    components = (name.split("_")[0] for name in _NAMES)
    columns |= dict(zip((f"estimability_{name}" for name in components), np.array(estimability).T, strict=True))
    if truth_m is not None:
        columns |= dict(zip((f"true_{name}" for name in _NAMES), truth_m.T, strict=False))
    if nees is not None:
        columns |= _square("nees", *nees)
    if bound_m is not None:
        columns["bound_m"] = bound_m
    if array_m is not None:
        columns |= dict(zip(("array_x_m", "array_y_m", "array_z_m"), array_m.T, strict=True))
    columns["status"] = [point.status for point in points]
    write_columns(columns, folder / "track.csv")
    save(track_figure(points, truth_m, array_m), folder / "track.png")
    save(consistency_figure(points, truth_m, nees, bound_m), folder / "consistency.png")
    if not quiet:
        print_note(f"wrote track.png, consistency.png and track.csv into {folder}/")


def _square(name: str, square: FloatArray, dof: IntArray) -> dict[str, Column]:
    """A normalised square, its degrees of freedom, and its 99 % bounds."""
    low, high = bounds99(dof)
    return {name: square, f"{name}_dof": dof, f"{name}_low99": low * dof, f"{name}_high99": high * dof}
