"""The picture of a track, and the data behind it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from arrays.toml import write_text
from magloc.commands.common import print_note
from magloc.plots import track_figure
from magloc.track import TrackPoint

FloatArray = NDArray[np.float64]


def write_picture(points: Sequence[TrackPoint], truth_m: FloatArray | None, folder: Path) -> None:
    """Write track.png and track.csv into a folder, which is made if it is not there."""
    folder.mkdir(parents=True, exist_ok=True)
    names = ("x_m", "y_m", "z_m", "mx_Am2", "my_Am2", "mz_Am2")
    lines = [",".join(["time_s", *names, *(f"s_{name}" for name in names), "nis", "nis_dof", "status"])]
    for point in points:
        cells = [repr(point.time_s)]
        if point.position_m is None or point.moment_Am2 is None or point.covariance is None:
            cells += [""] * 12
        else:
            numbers = [*point.position_m, *point.moment_Am2, *np.sqrt(np.diagonal(point.covariance))]
            cells += [f"{number:.9g}" for number in numbers]
        cells += [f"{point.nis:.6g}" if np.isfinite(point.nis) else "", str(point.nis_dof), f'"{point.status}"']
        lines.append(",".join(cells))
    write_text("\n".join([*lines, ""]), folder / "track.csv")
    track_figure(points, truth_m).savefig(folder / "track.png", dpi=130)
    print_note(f"wrote {folder / 'track.png'} and {folder / 'track.csv'}")
