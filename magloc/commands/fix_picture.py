"""The pictures of fixes, and the data behind them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arrays.sensor import SensorArray
from magloc.commands.common import print_note
from magloc.fix import Fix, JointFix
from magloc.output_files import Column, make_folder, write_columns
from magloc.plots import fix_figure, residual_figure, save
from magloc.plots.fix_figures import distances_from_truth, fix_columns
from magloc.plots.style import bounds99
from magloc.readings import Readings

FloatArray = NDArray[np.float64]

_NAMES = ("x_m", "y_m", "z_m", "mx_Am2", "my_Am2", "mz_Am2")


def write_pictures(
    rows: Readings,
    array: SensorArray,
    fixes: Sequence[Fix | JointFix],
    residuals: FloatArray,
    truth_m: FloatArray | None,
    folder: Path,
    *,
    quiet: bool = False,
) -> None:
    """Write fixes.png and residuals.png, and the data behind them as fixes.csv and residuals.csv.

    Parameters
    ----------
    rows : Readings
    array : SensorArray
    fixes : sequence of Fix or JointFix
        Of every row, in the world frame if the array's pose is known.
    residuals : ndarray, shape (n, C)
        Of their best solutions, in standard deviations of the noise.
    truth_m : ndarray, shape (n, 3), optional
        True positions in the frame of the fixes [m], NaN where they are not known.
    folder : Path
        Made if it is not there.
    quiet : bool
        Do not name the files on stderr.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    make_folder(folder, "--out")
    found = fix_columns(rows.time_s.tolist(), fixes)
    state = np.concatenate([found.position_m, found.moment_Am2], axis=1)
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    columns: dict[str, Column] = {"time_s": found.time_s, "source": found.source}
    columns |= dict(zip(_NAMES, state.T, strict=True))
    columns |= dict(zip((f"s_{name}" for name in _NAMES), sigma.T, strict=True))
    low, high = bounds99(found.dof)
    columns |= {"chi2": found.chi2, "dof": found.dof, "chi2_low99": low * found.dof, "chi2_high99": high * found.dof}
    columns |= {"range95_low_m": found.range95_m[:, 0], "range95_high_m": found.range95_m[:, 1]}
    columns["range_observable"] = found.range_observable
    if truth_m is not None:
        columns |= dict(zip((f"true_{name}" for name in _NAMES), truth_m[found.row].T, strict=False))
        columns["error_m"] = distances_from_truth(found, truth_m)
    columns["dropped_sensors"] = [" ".join(fixes[row].dropped) for row in found.row]
    columns["reason"] = [fixes[row].reason for row in found.row]
    write_columns(columns, folder / "fixes.csv")
    names = (f"{name}_residual_sigmas" for name in array.channel_names)
    write_columns({"time_s": rows.time_s, **dict(zip(names, residuals.T, strict=True))}, folder / "residuals.csv")
    save(fix_figure(found, sensors_of_rows(rows, array), truth_m), folder / "fixes.png")
    save(
        residual_figure(residuals, array.channel_names, array.ids, array.channel_sensor),
        folder / "residuals.png",
    )
    if not quiet:
        print_note(f"wrote fixes.png, fixes.csv, residuals.png and residuals.csv into {folder}/")


def sensors_of_rows(rows: Readings, array: SensorArray) -> FloatArray:
    """Sensors in every row (n, N, 3) [m]: in the world frame if the array's pose is known, else in the array's."""
    if rows.array_position_m is None or rows.array_rotation_xyzw is None:
        return np.broadcast_to(array.positions, (len(rows), *array.positions.shape))
    R = Rotation.from_quat(rows.array_rotation_xyzw).as_matrix()
    result: FloatArray = np.einsum("nab,sb->nsa", R, array.positions) + rows.array_position_m[:, None]
    return result
