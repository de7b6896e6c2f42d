"""Maps over sources: where around an array one start-free fix finds the source.

Each position of a cube has a source whose moment has a given size and a random direction, one set of readings with the
array's noise and stated errors, and one fix. The fix succeeds if a search from the truth finds no better solution. The
accuracy of that solution depends on physics, not on the search, so that the map includes the Cramér-Rao bound.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from arrays.io.errors import check_positive
from arrays.io.values import accept_seed, seed_of
from arrays.noise import reading_errors
from arrays.typing import BoolArray, FloatArray, Rng
from arrays.whitening import whitening
from magloc.bounds.crlb import check_uncertainty, cramer_rao_bounds
from magloc.chi_square import normalised_square
from magloc.fields.multipole import N_BODY_ERRORS, check_body_length, finite_body_errors
from magloc.grids.computed import computed_map
from magloc.grids.cube import (
    Box,
    CubeMap,
    Summary,
    Tally,
    Values,
    Variable,
    check_half_width,
    common_counts,
    flags,
    tallied,
)
from magloc.localization.fit.fixes import Fixes
from magloc.localization.fit.gauss_newton import JointFits, refine
from magloc.localization.fit.optima import Optima
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.fit.results import is_observable, spans
from magloc.localization.locator import Locator
from magloc.localization.model_errors import assumed_lengths, with_model_errors
from magloc.localization.search.kernels import SAME_CHI2, SAME_COSINE
from magloc.localization.search.single_source import N_UNKNOWNS
from magloc.measurement.differences import fields_at_sensors
from magloc.measurement.rows import check_magnitudes, whitened_rows
from magloc.measurement.whitened import WhitenedModel

if TYPE_CHECKING:
    import xarray as xr

# Largest excess of χ² over the optimum from the truth for a fix that found it.
CHI2_FOUND = 0.05
# Searches from the truth in the valleys of far sources take some hundred.
_MAX_ITERATIONS = 1000
# Seconds of one core that a fix takes, roughly: by vector sensors, of bodies, by moduli.
_FIX_S, _BODY_S, _SCALAR_S = 5e-5, 5e-4, 5e-3


class SourceStatus(IntEnum):
    """Result of the fix of a source."""

    FOUND = 0
    MISSED = 1
    UNSOLVED = 2
    LEFT_OUT = 3


@dataclass(frozen=True)
class SourcesScenario:
    """A cube of sources around an array.

    Attributes
    ----------
    array : SensorArray
        Array with at least six independent differences. Its ambient field has the stated error.
    half_width_m : float
        The cube reaches from -half_width to +half_width along every axis, around the array's centroid.
    nearest_m, farthest_m : float
        Sources nearer to the centroid, or farther from it, are not drawn.
    moment_Am2 : float
        Size of every source's moment.
    known_moment_sigma_Am2 : float
        Standard deviation of the moments' size, a prior of the fixes; if infinite, all moments have the same size, and
        fixes have no prior.
    body_length_m : float, optional
        Length of every source. Its multipole moments are random, and count as noise in fixes and bounds. By default a
        quarter of its distance near the array, as in :class:`magloc.Locator`; 0 for points.
    seed : int
        Seed of the moments' directions and all errors. The draws of a source depend only on the seed and on its place
        in the cube.
    """

    array: SensorArray = field(default_factory=lambda: tetrahedron(1.5, noise_T=1e-9))
    half_width_m: float = 12.0
    nearest_m: float = 1.0
    farthest_m: float = 12.0
    moment_Am2: float = 300.0
    seed: int = 0
    known_moment_sigma_Am2: float = np.inf
    body_length_m: float | None = None

    def __post_init__(self) -> None:
        check_magnitudes(self.array)  # before a store is made for it
        if not 0.0 <= self.nearest_m < self.farthest_m:
            raise ValueError(f"Input nearest_m must be between 0 and farthest_m; instead received {self.nearest_m}.")
        check_positive(moment_Am2=self.moment_Am2)
        check_uncertainty(0.0, self.known_moment_sigma_Am2)
        check_body_length(self.body_length_m or 0.0)

    @property
    def prior(self) -> SourcePrior:
        """Prior of the fixes."""
        if self.known_moment_sigma_Am2 == np.inf:
            return NOTHING_KNOWN
        return SourcePrior(known_moment_Am2=self.moment_Am2, known_moment_sigma_Am2=self.known_moment_sigma_Am2)


_NO_YES = {"flag_values": np.array([-1, 0, 1], dtype=np.int8), "flag_meanings": "left_out no yes"}
_LEFT_OUT = {
    "status": SourceStatus.LEFT_OUT,
    "iterations": 0,
    "solutions": 0,
    "truth_listed": -1,
    "range_observable": -1,
}
_VARIABLES = {
    "status": Variable(
        np.int8,
        {
            "long_name": "how the fix of the source ended",
            **flags(SourceStatus),
        },
    ),
    "iterations": Variable(np.int32, {"long_name": "linearisations that led to the best solution", "units": "1"}),
    "chi2": Variable(np.float64, {"long_name": "chi-square of the best solution and of its priors", "units": "1"}),
    "chi2_from_truth": Variable(
        np.float64, {"long_name": "chi-square of the optimum searched from the truth, if it converged", "units": "1"}
    ),
    "distance": Variable(np.float64, {"long_name": "distance of the best solution from the truth", "units": "m"}),
    "nees": Variable(
        np.float64, {"long_name": "squared error of the best solution over its covariance, per dimension", "units": "1"}
    ),
    "solutions": Variable(np.int32, {"long_name": "distinct solutions within 20 of the best chi-square", "units": "1"}),
    "truth_listed": Variable(
        np.int8, {"long_name": "whether the optimum searched from the truth is among the solutions", **_NO_YES}
    ),
    "range_observable": Variable(
        np.int8, {"long_name": "whether the readings fix the range of the best solution", **_NO_YES}
    ),
    "sigma_range": Variable(
        np.float64, {"long_name": "Cramer-Rao bound of the standard deviation of the range", "units": "m"}
    ),
    "sigma_position": Variable(
        np.float64, {"long_name": "Cramer-Rao bound of the position, root of the trace", "units": "m"}
    ),
}


@dataclass(frozen=True, eq=False)
class SourcesMap(CubeMap):
    """Map of fixes over a cube of sources."""

    title = "Start-free fixes over a cube of sources"
    variables = _VARIABLES

    scenario: SourcesScenario

    def __post_init__(self) -> None:
        super().__post_init__()
        n_differences = whitening(self.scenario.array).n_differences
        if n_differences < N_UNKNOWNS:
            raise ValueError(f"Input array gives {n_differences} independent differences, {N_UNKNOWNS} are needed.")

    def __getstate__(self) -> dict[str, Any]:
        return {"scenario": self.scenario, "grid": self.grid}  # the rest is large and cheap to compute again

    @cached_property
    def _locator(self) -> Locator:
        of = self.scenario
        return Locator(of.array, body_length_m=of.body_length_m, exclude_faulty=False, prior=of.prior)

    @cached_property
    def _model(self) -> WhitenedModel:
        array = self.scenario.array
        return WhitenedModel.of(array, whitening(array), array.ambient_fields[None])

    @property
    def point_s(self) -> float:
        """Approximate time of one core for a fix [s]."""
        scalar = self.scenario.array.channel_is_scalar.any()
        return _SCALAR_S if scalar else _BODY_S if self.scenario.body_length_m else _FIX_S

    @property
    def settings(self) -> Mapping[str, Any]:
        """Selection of sources, and method."""
        scenario = self.scenario
        return {
            "method": "global",
            "nearest_m": scenario.nearest_m,
            "farthest_m": scenario.farthest_m,
            "moment_magnitude_Am2": scenario.moment_Am2,
            "seed": str(scenario.seed),  # of any size
            **({"known_moment_sigma_Am2": known} if (known := scenario.known_moment_sigma_Am2) < np.inf else {}),
            **({"body_length_m": length} if (length := scenario.body_length_m) is not None else {}),
        }

    def values_at(self, box: Box) -> Mapping[str, Any]:
        """Return the fixes of the sources of a box."""
        relative = box.points(self.axis)
        distance = np.linalg.norm(relative, axis=1)
        used = (distance >= self.scenario.nearest_m) & (distance <= self.scenario.farthest_m)
        of_used: Mapping[str, Any] = {}
        if used.any():
            position = self.scenario.array.centroid + relative[used]
            moment, noise, errors = (part[used] for part in self._random(box))
            of_used = self._values_of(position, moment, self._readings(position, moment, noise, errors))
        values = {}
        for name, variable in _VARIABLES.items():
            of_all = np.full(box.size, _LEFT_OUT.get(name, np.nan), variable.dtype)
            of_all[used] = of_used.get(name, ())
            values[name] = of_all
        return values

    def _values_of(self, position: FloatArray, moment: FloatArray, readings: FloatArray) -> Mapping[str, Any]:
        """Return fixes of sources (n, 3) from their raw readings (n, C)."""
        fixes = self._locator.fit_rows(readings)
        from_truth = self._search_from(position, moment, readings)
        solved, every = fixes.solved, fixes.solutions
        first = fixes.first[solved]

        def of_first(values: Any, empty: float) -> Any:
            column = np.full(len(fixes), empty, dtype=np.asarray(values).dtype)
            column[solved] = values
            return column

        chi2 = of_first((every.chi2 + every.known_chi2)[first], np.nan)
        found = np.where(chi2 <= from_truth.chi2 + CHI2_FOUND, SourceStatus.FOUND, SourceStatus.MISSED)
        bounds = cramer_rao_bounds(
            self.scenario.array,
            position,
            moment,
            known_moment_sigma_Am2=self.scenario.known_moment_sigma_Am2,
            body_length_m=self._lengths(position),
        )
        estimate = np.concatenate([every.position_m[first, 0], every.moment_Am2[first, 0]], axis=1)
        error = estimate - np.concatenate([position[solved], moment[solved]], axis=1)
        nees = np.where(every.gaussian[first, 0], normalised_square(error, every.covariance[first]), np.nan)
        return {
            "status": np.where(np.isnan(chi2), SourceStatus.UNSOLVED, found),
            "iterations": of_first(every.iterations[first], 0),
            "chi2": chi2,
            "chi2_from_truth": np.where(from_truth.converged, from_truth.chi2, np.nan),
            "distance": of_first(np.linalg.norm(error[:, :3], axis=1), np.nan),
            "nees": of_first(nees / N_UNKNOWNS, np.nan),
            "solutions": np.bincount(every.of_row, minlength=len(fixes)),
            "truth_listed": self._includes_truth(fixes, from_truth),
            "range_observable": of_first(is_observable(*spans(every.ranges[first, 0]).T), False),
            "sigma_range": bounds.sigma_range_m,
            "sigma_position": bounds.sigma_position_m,
        }

    def _random(self, box: Box) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return moments (n, 3) [A·m²] of a box, noise (n, C) and model errors (n, 17).

        Noise and errors are standard normal numbers.
        """
        known = self.scenario.known_moment_sigma_Am2 < np.inf
        normal = self._normal(box, 3 + self.scenario.array.n_channels + known, 0)
        direction = normal[:, :3] / np.linalg.norm(normal[:, :3], axis=1, keepdims=True)
        size = self.scenario.moment_Am2 + (self.scenario.known_moment_sigma_Am2 * normal[:, -1:] if known else 0.0)
        noise = normal[:, 3 : 3 + self.scenario.array.n_channels]
        return size * direction, noise, self._normal(box, N_BODY_ERRORS + 3, 1)

    def _normal(self, box: Box, n_numbers: int, stream: int) -> FloatArray:
        """Return standard normal numbers (n, n_numbers) of a box, independent by stream.

        They do not depend on the division into boxes.
        """
        key = np.random.SeedSequence(self.scenario.seed).generate_state(2, np.uint64)
        x, y, z = box.region
        lines = []
        for i in range(x.start, x.stop):
            for j in range(y.start, y.stop):
                generator = np.random.Generator(np.random.Philox(key=key, counter=[0, stream, i, j]))
                lines.append(generator.standard_normal((z.stop, n_numbers))[z])
        return np.concatenate(lines)

    def _lengths(self, position: FloatArray) -> FloatArray:
        """Return the lengths (n,) of the bodies at places (n, 3) [m]."""
        q = self._model.homogeneous(position)[:, None]
        return assumed_lengths(self._model, q, self.scenario.body_length_m)[:, 0]

    def _readings(self, position: FloatArray, moment: FloatArray, noise: FloatArray, errors: FloatArray) -> FloatArray:
        """Return raw readings (n, C) [T] from standard normal noise and model errors."""
        array = self.scenario.array
        of_body, of_ambient = np.split(errors[:, None], [N_BODY_ERRORS], axis=-1)
        fields = fields_at_sensors(array, position, moment) + array.row_ambient_uncertainty_T * of_ambient
        length_m = self._lengths(position)[:, None, None, None]
        if length_m.any():
            beyond = finite_body_errors(array.positions - position[:, None], moment[:, None], length_m)
            fields += (beyond @ of_body[..., None])[..., 0]
        exact = array.readings_of(fields)
        return exact + reading_errors(array, exact, noise)

    def _search_from(self, position: FloatArray, moment: FloatArray, readings: FloatArray) -> JointFits:
        """Refine from the truth (n, 3); χ² is infinite where it has not converged."""
        scenario = self.scenario
        (rows,) = whitened_rows(scenario.array, readings, None, len(readings))
        rows, q = rows.with_known_moment(scenario.prior.known_moment), rows.model.homogeneous(position)[:, None]
        mu = rows.model.scaled_moment(q, moment[:, None])
        fits = refine(rows.model, rows.y, q, mu, max_iterations=_MAX_ITERATIONS)
        of_row = np.flatnonzero(fits.converged)
        optima = Optima(rows, fits.rows(of_row), of_row, [""] * len(rows))
        for of_some, _ in with_model_errors(optima, scenario.body_length_m, scenario.array.row_ambient_uncertainty_T):
            fits.put(of_some.rows.index[of_some.of_row], of_some.fits)
        return fits

    def _includes_truth(self, fixes: Fixes, ends: JointFits) -> BoolArray:
        """Return whether solutions (n,) include the optimum of the search from the truth."""
        every = fixes.solutions
        cosine = np.sum(self._model.homogeneous(every.position_m[:, 0]) * ends.q[every.of_row, 0], axis=1)
        chi2 = every.chi2 + every.known_chi2
        same = (np.abs(cosine) > SAME_COSINE) & (np.abs(chi2 - ends.chi2[every.of_row]) < SAME_CHI2)
        return np.bincount(every.of_row[same], minlength=len(fixes)) > 0


@dataclass(frozen=True)
class SourcesSummary(Summary):
    """Counts of a map over sources, and fractions of these.

    Attributes
    ----------
    truth_listed : float
        Share of sources whose solutions include the optimum from the truth.
    not_converged : float
        Share of sources whose search from the truth did not converge, so that their fixes count as found.
    """

    truth_listed: float
    not_converged: float

    def lines(self) -> list[str]:
        """Return the counts in words."""
        return [
            f"{self.converged} of {self.starts} sources found ({self.fraction:.2%}), "
            f"truth listed {self.truth_listed:.2%}, median {self.median_iterations:.0f} iterations"
            + (f"; from the truth {self.not_converged:.2%} did not converge" if self.not_converged > 0.0 else "")
        ]


def _tally(values: Values) -> Tally:
    """Return the counts of ``status``, ``truth_listed`` and so on of a part of a map."""
    used = values["status"] != SourceStatus.LEFT_OUT
    points = {
        "starts": used,
        "not converged": used & np.isnan(values["chi2_from_truth"]),
        "converged": values["status"] == SourceStatus.FOUND,
        "truth listed": values["truth_listed"] == 1,
    }
    return Tally.of(points, values["iterations"])


@accept_seed
def source_map(
    array: SensorArray,
    moment_Am2: float = SourcesScenario.moment_Am2,
    *,
    edge_m: float = 2.0 * SourcesScenario.half_width_m,
    n: int = 21,
    nearest_m: float = SourcesScenario.nearest_m,
    farthest_m: float = SourcesScenario.farthest_m,
    rng: Rng = 0,
    known_moment_sigma_Am2: float = np.inf,
    body_length_m: float | None = None,
    out: str | PathLike[str] | None = None,
    scheduler: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    r"""Fix every source of a cube once, with random moments and noise.

    Parameters
    ----------
    array : SensorArray
        Array with at least six independent differences. Its ambient field has the stated error, new for every source.
    moment_Am2 : float
        Size of every source's moment [A·m²].
    edge_m : float
        Edge of the cube, which is centred on the array's centroid [m].
    n : int
        Sources along every axis, at least 2.
    nearest_m, farthest_m : float
        Sources nearer to the centroid, or farther from it, are not drawn [m].
    rng : int or numpy.random.Generator
        Seed or generator of the moments' directions and all errors.
    known_moment_sigma_Am2 : float
        Standard deviation of the moments' modulus [A·m²], which fixes and bounds know; infinite: one unknown modulus.
    body_length_m : float, optional
        Length of every source [m]. The deviation of its field from a dipole is random, and counts as noise in fixes
        and bounds. By default a quarter of its distance near the array, as in :func:`magloc.locate`; 0 for points.
    out : path-like, optional
        Folder of a zarr store for the map. Finished parts that it has are not computed again.
    scheduler, progress : optional
        Address of a dask scheduler, whose workers compute the map; called with the number of sources newly finished.

    Returns
    -------
    xarray.Dataset
        Over the source's (x, y, z) relative to the centroid [m]: ``status`` (found: the best solution's χ² is at most
        0.05 above that of the optimum searched from the truth), ``iterations``, ``chi2``, ``chi2_from_truth`` (NaN
        where that search did not converge), ``distance`` of the best solution from the truth [m], its ``nees`` per
        dimension (NaN where it is not Gaussian), number of ``solutions``, ``truth_listed``,
        ``range_observable``, and the Cramér-Rao bounds of the range and the position, ``sigma_range``
        :math:`\sqrt{u^T C_{pp} u}` and ``sigma_position`` :math:`\sqrt{\mathrm{tr}\, C_{pp}}` [m].

    Raises
    ------
    ValueError
        The array has too few sensors, or an input is out of range.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> found = magloc.source_map(arrays.tetrahedron(1.5), n=3)
    >>> sorted(found.sizes)
    ['x', 'y', 'z']
    """
    half, seed = check_half_width(edge_m), seed_of(rng)
    scenario = SourcesScenario(
        array, half, nearest_m, farthest_m, moment_Am2, seed, known_moment_sigma_Am2, body_length_m
    )
    return computed_map(SourcesMap(scenario, n), out, scheduler, progress)


def summary(dataset: xr.Dataset) -> SourcesSummary:
    """Return the counts of a map by :func:`source_map`, which need not fit into memory."""
    tally = tallied(dataset, ("status", "truth_listed", "iterations", "chi2_from_truth"), _tally)
    return SourcesSummary(
        **common_counts(dataset, tally),
        truth_listed=tally.fraction("truth listed", "starts"),
        not_converged=tally.fraction("not converged", "starts"),
    )
