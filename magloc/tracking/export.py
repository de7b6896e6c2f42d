"""Tracks for other programs: xarray datasets."""

from __future__ import annotations

from importlib import metadata
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

if TYPE_CHECKING:
    from magloc.tracking.track import Track

_COLUMNS = {
    "position_m": (("axis",), "m", "position of the source"),
    "moment_Am2": (("axis",), "A m2", "magnetic moment of the source"),
    "covariance": (("component", "component_"), "m, A m2", "covariance of (position, moment)"),
    "estimability": (("component",), "1", "what the row taught: 1 - sigma after / sigma predicted"),
    "nis": ((), "1", "normalised innovation squared"),
    "nis_dof": ((), "1", "degrees of freedom of nis"),
    "weight": ((), "1", "probability that the track is the right one"),
    "tracked": ((), "1", "whether the source is tracked"),
    "status": ((), "1", "how the row was used, or why there is no track"),
}


def dataset_of_track(track: Track) -> xr.Dataset:
    """:meth:`magloc.tracking.track.Track.to_xarray`."""
    dataset = xr.Dataset(coords={"time_s": ("row", track.time_s), "axis": list("xyz")})
    for name, (dimensions, unit, words) in _COLUMNS.items():
        attributes = {"units": unit, "long_name": words}
        dataset[name] = (("row", *dimensions), np.asarray(getattr(track, name)), attributes)
    dataset["time_s"].attrs = {"units": "s", "long_name": "time"}
    dataset.attrs = {"frame": track.frame, "source": f"magloc {metadata.version('magloc')}, track"}
    return dataset
