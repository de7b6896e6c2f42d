"""The bounds of one source and the reach of an array, as JSON and as text."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from magloc.bounds.crlb import Bounds
from magloc.bounds.maps import CASES, BoundScenario
from magloc.bounds.over_moments import MomentBounds

if TYPE_CHECKING:
    import xarray as xr

    from magloc.detection.matched_filter import MatchedFilterDetector

_SPREAD = ("mean", "median", "q95", "worst_sampled")
_CASES_IN_WORDS = ("given moment [m]", "median of moments [m]", "95 % of moments [m]", "worst of those sampled [m]")


@dataclass(frozen=True, eq=False)
class BoundsReport:
    """The bounds of a source, and the distances that an array reaches.

    Attributes
    ----------
    source : Bounds
        Bounds for the given moment.
    over_moments : MomentBounds
        Bounds of the same position over sampled moments.
    spheres : xarray.Dataset
        Reach by direction, from :func:`magloc.bounds.spheres.bound_spheres`.
    scenario : BoundScenario
        Array and source of the bounds.
    body_length_m : float
        Length of the source; 0 for a point.
    detector : MatchedFilterDetector, optional
        Detector of the reach ``detection_range``; None for an array without one.
    """

    source: Bounds
    over_moments: MomentBounds
    spheres: xr.Dataset
    scenario: BoundScenario
    body_length_m: float
    detector: MatchedFilterDetector | None

    def json(self) -> dict[str, Any]:
        """Return the keys that ``magloc bounds --json`` prints of the source and of the reach."""
        source, detector = self.source, self.detector
        spreads = (
            ("sigma_range_m", self.over_moments.sigma_range_m, 1.0),
            ("sigma_bearing_deg", self.over_moments.sigma_bearing_rad, math.degrees(1.0)),
        )
        detection = None if detector is None else {
            "probability": self.spheres.attrs["detection_probability"],
            "false_alarm_rate": detector.false_alarm_rate,
            "threshold": detector.threshold,
            "threshold_error": detector.threshold_error,
        }  # fmt: skip
        return {
            "position_m": source.position_m,
            "moment_Am2": source.moment_Am2,
            "range_m": float(source.range_m),
            **({"body_length_m": self.body_length_m} if self.body_length_m else {}),
            "rank": int(source.rank),
            "sigma_position_m": source.sigma[:3],
            "sigma_moment_Am2": source.sigma[3:],
            "sigma_range_m": float(source.sigma_range_m),
            "sigma_bearing_deg": math.degrees(source.sigma_bearing_rad),
            "over_moments": {
                name: dict(zip(_SPREAD, (factor * float(value[0]) for value in spread), strict=True))
                for name, spread, factor in spreads
            },
            "accuracy_m": self.scenario.accuracy_m,
            "accuracy_range_m": reach(self.spheres, "accuracy_range"),
            "detection": detection,
            "detection_range_m": None if detector is None else reach(self.spheres, "detection_range"),
        }

    def lines(self) -> list[str]:
        """Return the tables that ``magloc bounds`` prints."""
        source, over = self.source, self.over_moments
        place, moment = plain_vector(source.position_m), plain_vector(source.moment_Am2)
        spreads = (
            ("range [m]", source.sigma_range_m, over.sigma_range_m, 1.0),
            ("bearing [°]", source.sigma_bearing_rad, over.sigma_bearing_rad, math.degrees(1.0)),
        )
        lines = [
            f"source at {place} m, moment {moment} A·m², {float(source.range_m):.4g} m from the sensors' centroid",
            _row("least σ", "xyz"),
            _row("position [m]", source.sigma[:3]),
            _row("moment [A·m²]", source.sigma[3:]),
            "",
            _row("least σ", ("given", "mean", "median", "95 %", "worst")),
            *(
                _row(name, [factor * float(x) for x in (given, *np.ravel(spread))])
                for name, given, spread, factor in spreads
            ),
        ]
        if not source.is_regular:
            rank = int(source.rank)
            lines.insert(
                4, f"Only {rank} of the six combinations of position and moment are estimable: inf = not at all."
            )
        titles = {"accuracy_range": f"σ of range ≤ {self.scenario.accuracy_m:g} m up to"}
        if self.detector is not None:
            titles["detection_range"] = f"found with {100.0 * self.spheres.attrs['detection_probability']:g} % up to"
        for variable, title in titles.items():
            lines += ["", _row(title, ("least", "median", "greatest"), 32)]
            for name, of_case in zip(_CASES_IN_WORDS, reach(self.spheres, variable).values(), strict=True):
                lines.append(_row(name, of_case.values(), 32))
        return lines


def reach(spheres: xr.Dataset, variable: str) -> dict[str, dict[str, float]]:
    """Return least, median and greatest reach over the directions, each weighted by its share of the sphere."""
    weights = np.cos(np.radians(spheres["elevation"].to_numpy()))[:, None] * np.ones(spheres.sizes["azimuth"] - 1)
    result = {}
    for case, name in zip(CASES, ("moment", *_SPREAD[1:]), strict=True):
        distance = spheres[f"{variable}{case}"].to_numpy()[:, :-1]  # the last azimuth is the first one again
        order = np.argsort(distance, axis=None)
        share = np.cumsum(weights.ravel()[order])
        median = distance.ravel()[order[np.searchsorted(share, 0.5 * share[-1])]]
        result[name] = {"least": float(distance.min()), "median": float(median), "greatest": float(distance.max())}
    return result


def plain_vector(vector: Iterable[float]) -> str:
    """Return a vector as text, such as ``(5, 0, 0.306)``."""
    return f"({', '.join(f'{value:g}' for value in vector)})"


def _row(title: str, cells: Iterable[str | float], width: int = 22) -> str:
    """Return a row of a table: a title, and cells of ten characters."""
    texts = (cell if isinstance(cell, str) else f"{cell:.4g}" for cell in cells)
    return f"{title:<{width}}" + "".join(f"{text:>10}" for text in texts)
