"""Export of fixes: columns, xarray datasets and GeoJSON."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from arrays.io.csv import Column
from arrays.io.results import Quantity
from arrays.io.world_maps import feature, feature_collection
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.chi_square import square_columns
from magloc.localization.fit.results import is_observable, spans
from magloc.truth import STATE_COLUMNS, STATE_QUANTITIES, state_columns

if TYPE_CHECKING:
    import xarray as xr

    from magloc.localization.fit.fixes import Fixes

QUANTITIES = STATE_QUANTITIES | {
    "range_low_m": Quantity("m", "least distance from the sensors' centroid, 95 % set"),
    "range_high_m": Quantity("m", "largest distance from the sensors' centroid, 95 % set; infinite where open"),
    "gaussian": Quantity("1", "whether the covariance describes the uncertainty"),
    "merged": Quantity("1", "whether the source represents two that the array cannot separate"),
    "chi2": Quantity("1", "sum of squared residuals of the decorrelated differences"),
    "dof": Quantity("1", "differences minus unknowns"),
    "weight": Quantity("1", "probability that the solution is the right one"),
    "n_sources": Quantity("1", "sources of the solution"),
    "detected": Quantity("1", "whether the readings exceed noise"),
    "misfit": Quantity("1", "whether χ² is far beyond noise"),
    "body_length_m": Quantity("m", "length of the object that was taken into account, 0 for a point"),
    "body_factor": Quantity(
        "1", "errors over standard deviations, rms, if a point were a quarter of its distance long"
    ),
    "too_near": Quantity("1", "whether the source is too near for a dipole"),
    "dropped_sensors": Quantity("1", "sensors that contradict all others"),
    "saturated_channels": Quantity("1", "channels whose reading saturates"),
    "reason": Quantity("1", "why there is no solution"),
}
"""Variables of :meth:`magloc.localization.fit.fixes.Fixes.to_xarray`."""
_OF_ROWS = ("detected", "misfit", "too_near", "body_length_m", "body_factor")


@dataclass(frozen=True, eq=False)
class FixColumns:
    """Columns of the k sources of the best solutions of all rows; NaN if a row has none.

    Attributes
    ----------
    row : ndarray of int, shape (k,)
        Row of each source.
    source : ndarray of int, shape (k,)
        Number of each source in its row, from 1; 0 if a row has no solution.
    time_s, chi2 : ndarray, shape (k,)
    dof : ndarray of int, shape (k,)
    position_m, moment_Am2 : ndarray, shape (k, 3)
    covariance : ndarray, shape (k, 6, 6)
        Covariance of (position, moment); zero for a known position.
    range_observable : ndarray of bool, shape (k,)
    range95_m : ndarray, shape (k, 2)
        Ends of the 95 % interval of the distance from the sensors' centroid; the upper end may be infinite.
    """

    row: IntArray
    source: IntArray
    time_s: FloatArray
    chi2: FloatArray
    dof: IntArray
    position_m: FloatArray
    moment_Am2: FloatArray
    covariance: FloatArray
    range_observable: BoolArray
    range95_m: FloatArray

    @property
    def first(self) -> BoolArray:
        """Mask with one source of every row, for values that belong to the row."""
        return self.source <= 1


def fix_columns(fixes: Fixes) -> FixColumns:
    """Return the sources of the best solutions of all rows."""
    columns, best = fixes.solutions, fixes.best
    number = np.where(fixes.solved, columns.n_sources[best] if len(columns) else 0, 1)
    row = np.repeat(np.arange(len(fixes)), number)
    solved = fixes.solved[row]
    place = np.arange(len(row)) - np.repeat(np.cumsum(number) - number, number)
    at = best[row][solved], place[solved]
    n = len(row)
    position, moment, intervals = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.full((n, 2), np.nan)
    covariance = np.full((n, 6, 6), np.nan)
    position[solved], moment[solved] = columns.position_m[at], columns.moment_Am2[at]
    of_source = columns.covariance_of_source[at]
    n_known = 6 - of_source.shape[1]  # a known position is exact
    covariance[solved] = 0.0
    covariance[solved, n_known:, n_known:] = of_source
    intervals[solved] = spans(columns.ranges[at])
    return FixColumns(
        row=row,
        source=np.where(solved, place + 1, 0),
        time_s=fixes.time_s[row],
        chi2=fixes.chi2[row],
        dof=fixes.dof[row],
        position_m=position,
        moment_Am2=moment,
        covariance=covariance,
        range_observable=is_observable(*intervals.T),
        range95_m=intervals,
    )


def distances_from_truth(columns: FixColumns, truth_m: FloatArray) -> FloatArray:
    """Return distances (k,) [m] of sources from the truth (n, 3) of their rows.

    Only known coordinates of the truth count.
    """
    offset = columns.position_m - truth_m[columns.row]
    known = np.isfinite(truth_m[columns.row])
    distance = np.sqrt(np.where(known, offset**2, 0.0).sum(axis=1))
    return np.where(known.any(axis=1), distance, np.nan)


def columns_of_fixes(fixes: Fixes, truth_m: FloatArray | None = None) -> dict[str, Column]:
    """Return the columns of fixes.csv, with the errors against a truth (n, 3) [m]."""
    found = fix_columns(fixes)
    columns: dict[str, Column] = {"time_s": found.time_s, "source": found.source}
    columns |= state_columns(found.position_m, found.moment_Am2, found.covariance)
    columns |= square_columns("chi2", found.chi2, found.dof)
    columns |= {"range95_low_m": found.range95_m[:, 0], "range95_high_m": found.range95_m[:, 1]}
    columns["range_observable"] = found.range_observable
    if truth_m is not None:
        columns |= dict(zip((f"true_{name}" for name in STATE_COLUMNS), truth_m[found.row].T, strict=False))
        columns["error_m"] = distances_from_truth(found, truth_m)
    columns |= {name: getattr(fixes, name)[found.row] for name in ("detected", "misfit", "too_near", "body_length_m")}
    columns["dropped_sensors"] = [" ".join(fixes.dropped_sensors[row]) for row in found.row]
    columns["reason"] = [fixes.reason[row] for row in found.row]
    return columns | {"body_factor": fixes.body_factor[found.row]}


def dataset_of_fixes(fixes: Fixes, which: Literal["best", "all"]) -> xr.Dataset:
    """Return fixes as a dataset, see :meth:`magloc.localization.fit.fixes.Fixes.to_xarray`."""
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

    of_source = {
        "position_m": columns.position_m[chosen],
        "moment_Am2": columns.moment_Am2[chosen],
        "covariance": columns.covariance_of_source[chosen],
        "range_low_m": ends[..., 0],
        "range_high_m": ends[..., 1],
    }
    of_rows: dict[str, Any] = {"time_s": fixes.time_s} | {name: getattr(fixes, name) for name in _OF_ROWS}
    for name in ("dropped_sensors", "saturated_channels"):
        of_rows[name] = np.array([" ".join(names) for names in getattr(fixes, name)], dtype=str)
    of_rows["reason"] = np.array(fixes.reason, dtype=str)
    source = (*leading, "source")
    dataset = fixes.dataset(
        {
            name: ((*source, *fixes.quantities[name].dimensions), table(values, np.nan))
            for name, values in of_source.items()
        }
        | {name: (source, table(getattr(columns, name)[chosen], False)) for name in ("gaussian", "merged")}
        | {name: (leading, table(getattr(columns, name)[chosen], np.nan)) for name in ("chi2", "weight")}
        | {name: (leading, table(getattr(columns, name)[chosen], 0)) for name in ("dof", "n_sources")}
        | {name: (("row",), values) for name, values in of_rows.items()}
    )
    if which == "all":
        dataset.attrs["solution"] = "best χ² first; rows with fewer solutions are padded with NaN"
    return dataset


def geojson_of_fixes(fixes: Fixes) -> dict[str, Any]:
    """Return fixes as GeoJSON, see :meth:`magloc.localization.fit.fixes.Fixes.to_geojson`."""
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
            features.append(feature("Point", source.position_m.tolist(), properties))
    return feature_collection(features) | {"frame": fixes.frame}
