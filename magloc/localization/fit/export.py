"""Fixes for other programs: xarray datasets and GeoJSON."""

from __future__ import annotations

from importlib import metadata
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import xarray as xr

from arrays.typing import IntArray
from magloc.localization.fit.results import spans

if TYPE_CHECKING:
    from magloc.localization.fit.fixes import Fixes

_UNITS = {
    "position_m": ("m", "position of the source"),
    "moment_Am2": ("A m2", "magnetic moment of the source"),
    "covariance": ("m, A m2", "covariance of (position, moment)"),
    "range_low_m": ("m", "least distance from the sensors' centroid, 95 % set"),
    "range_high_m": ("m", "largest distance from the sensors' centroid, 95 % set; infinite where it is open"),
    "gaussian": ("1", "whether the covariance describes the uncertainty"),
    "merged": ("1", "whether the source stands for two"),
    "chi2": ("1", "sum of squared residuals of the decorrelated differences"),
    "dof": ("1", "differences minus unknowns"),
    "weight": ("1", "probability that the solution is the right one"),
    "n_sources": ("1", "sources of the solution"),
    "detected": ("1", "whether the readings stand out of noise"),
    "misfit": ("1", "whether χ² is far beyond noise"),
    "body_length_m": ("m", "length of the object that was taken into account, 0 for a point"),
    "body_factor": ("1", "errors over their standard deviations, rms, if a point were a quarter of its distance long"),
    "too_near": ("1", "whether the source is too near for a dipole"),
    "dropped_sensors": ("1", "sensors that contradict all others"),
    "saturated_channels": ("1", "channels whose reading saturates"),
    "reason": ("1", "why there is no solution"),
}

_OF_ROWS = ("detected", "misfit", "too_near", "body_length_m", "body_factor")


def dataset_of_fixes(fixes: Fixes, which: Literal["best", "all"]) -> xr.Dataset:
    """:meth:`magloc.localization.fit.fixes.Fixes.to_xarray`."""
    columns = fixes.solutions
    n = len(fixes)
    at: tuple[IntArray, ...]
    leading: tuple[str, ...]
    shape: tuple[int, ...]
    if which == "best":
        at, chosen = (np.flatnonzero(fixes.solved),), fixes.best[fixes.solved]
        leading, shape = ("row",), (n,)
    elif which == "all":
        place = np.arange(len(columns)) - fixes.first[columns.of_row]
        at, chosen = (columns.of_row, place), np.arange(len(columns))
        leading, shape = ("row", "solution"), (n, int(place.max(initial=-1)) + 1)
    else:
        raise ValueError(f"Input which must be 'best' or 'all'; instead received {which!r}.")
    ends = spans(columns.ranges[chosen])

    def table(values: Any, empty: Any) -> Any:
        full = np.full((*shape, *values.shape[1:]), empty, dtype=np.result_type(values, type(empty)))
        full[at] = values
        return full

    blocks = columns.covariance_of_source[chosen]
    source = (*leading, "source")
    variables = {
        "position_m": ((*source, "axis"), table(columns.position_m[chosen], np.nan)),
        "moment_Am2": ((*source, "axis"), table(columns.moment_Am2[chosen], np.nan)),
        "covariance": ((*source, "component", "component_"), table(blocks, np.nan)),
        "range_low_m": (source, table(ends[..., 0], np.nan)),
        "range_high_m": (source, table(ends[..., 1], np.nan)),
        "gaussian": (source, table(columns.gaussian[chosen], False)),
        "merged": (source, table(columns.merged[chosen], False)),
        **{name: (leading, table(getattr(columns, name)[chosen], np.nan)) for name in ("chi2", "weight")},
        **{name: (leading, table(getattr(columns, name)[chosen], 0)) for name in ("dof", "n_sources")},
        **{name: ("row", getattr(fixes, name)) for name in _OF_ROWS},
        **{
            name: ("row", np.array([" ".join(names) for names in getattr(fixes, name)], dtype=str))
            for name in ("dropped_sensors", "saturated_channels")
        },
        "reason": ("row", np.array(fixes.reason, dtype=str)),
    }
    dataset = xr.Dataset(variables, coords={"time_s": ("row", fixes.time_s), "axis": list("xyz")})
    for name, (unit, words) in _UNITS.items():
        dataset[name].attrs = {"units": unit, "long_name": words}
    dataset["time_s"].attrs = {"units": "s", "long_name": "time"}
    dataset.attrs = {"frame": fixes.frame, "source": f"magloc {metadata.version('magloc')}, locate"}
    if which == "all":
        dataset.attrs["solution"] = "best χ² first; rows with fewer solutions are padded with NaN"
    return dataset


def geojson_of_fixes(fixes: Fixes) -> dict[str, Any]:
    """:meth:`magloc.localization.fit.fixes.Fixes.to_geojson`."""
    features = []
    for fix in fixes:
        for k, source in enumerate(fix.best.sources if fix.solutions else ()):
            sigma = np.sqrt(np.diagonal(source.covariance)) if source.covariance is not None else np.full(6, np.nan)
            properties = {
                "time_s": fix.time_s,
                "source": k + 1,
                "moment_Am2": source.moment_Am2.tolist(),
                "sigma": sigma.tolist(),
                "detected": fix.detected,
                "range_observable": source.range_observable,
            }
            geometry = {"type": "Point", "coordinates": source.position_m.tolist()}
            features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return {"type": "FeatureCollection", "frame": fixes.frame, "features": features}
