"""The kernel of the uncertainty of one source, in all instruction sets of this machine.

| what | who checks it |
|---|---|
| covariances | the singular values of the readable Jacobian |
| weights, ranges, whether errors are Gaussian | fit_columns, the readable reference |
| blocks, threads, lanes | each other: bit for bit |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from arrays.array import SensorArray
from arrays.sensor import Sensor
from magloc.localization.fit import refinement
from magloc.localization.fit.gauss_newton import covariances
from magloc.localization.fit.optima import Optima
from magloc.localization.fit.results import is_misfit, is_observable, spans
from magloc.localization.search.single_source import SingleSourceSearch
from magloc.localization.uncertainty.covariance import fit_columns, single_source_columns
from magloc.measurement.rows import whitened_rows
from tests.magloc.localization.search.test_candidates import CASES, regime

N_ROWS = 61  # no multiple of a number of lanes
ARRAYS = {
    "isotropic": CASES["tetrahedron 1.5 m"][0],
    "irregular": CASES["seven irregular"][0],
    "noise of each row": replace(CASES["tetrahedron 1.5 m"][0], noise_fraction=1e-3),
    "common field with a prior": replace(CASES["tetrahedron 1.5 m"][0], common_field_T=3e-9),
    "thirty sensors": CASES["board of thirty"][0],
}


pytestmark = pytest.mark.usefixtures("instruction_set")


def optima_of(array: SensorArray, name: str = "product", n_rows: int = N_ROWS) -> Optima:
    _, _, readings = regime(name, n_rows, np.random.default_rng(12), array)
    readings[5:8, 3] += 30.0 * array.channel_noise_T[3]  # misfits
    (rows,) = whitened_rows(array, readings, None, n_rows)
    (optima,) = SingleSourceSearch(array).optima(rows)
    return optima


def same_ranges(found, expected):
    """Whether sets of ranges (f, 1, i, 2) are equal to 2 %, or 2 cm."""
    n = expected.shape[2]
    same = np.isclose(found[:, :, :n], expected, rtol=0.02, atol=0.02, equal_nan=True).all(axis=(1, 2, 3))
    return same & np.isnan(found[:, :, n:]).all(axis=(1, 2, 3))


@pytest.mark.parametrize("case", ARRAYS)
@pytest.mark.parametrize("name", ["near", "product", "far"])
class TestAgainstReference:
    def test_covariances(self, case: str, name: str) -> None:
        """Where the range is observable: all others are made longer."""
        optima = optima_of(ARRAYS[case], name)
        found = single_source_columns(optima)
        expected = covariances(optima.rows.model.rows(optima.of_row), optima.fits)
        assert np.isfinite(expected).all()
        best = optima.fits.chi2[np.searchsorted(optima.of_row, optima.of_row)]
        expected *= np.where(is_misfit(best, optima.dof), best / optima.dof, 1.0)[:, None, None]
        low, high = spans(found.ranges[:, 0]).T
        kept = is_observable(low, high)
        assert np.count_nonzero(kept) >= (0 if name == "far" else 20)
        sigma = np.sqrt(np.einsum("fii->fi", expected))
        apart = (found.covariance - expected) / (sigma[:, :, None] * sigma[:, None])
        assert_allclose(apart[kept], 0.0, atol=1e-6)
        assert_array_equal(np.einsum("fii->fi", found.covariance) >= 0.999 * sigma**2, True)

    def test_all_together(self, case: str, name: str) -> None:
        """Ends of ranges are read from the profile at a rise of 3.84 to about 0.01."""
        optima = optima_of(ARRAYS[case], name)
        found, expected = single_source_columns(optima), fit_columns(optima, np.ones(len(optima.rows), bool))
        assert_allclose(found.position_m, expected.position_m, rtol=1e-12, atol=1e-12)
        assert_allclose(found.moment_Am2, expected.moment_Am2, rtol=1e-12)
        assert_allclose(found.weight, expected.weight, atol=1e-6)
        assert_array_equal(found.gaussian, expected.gaussian)
        same = same_ranges(found.ranges, expected.ranges)
        # The steps of the reference are longer: in a few rows they leap over a rise of chi-square.
        assert np.mean(same) >= {"near": 0.97, "product": 1.0, "far": 0.9}[name]
        sigma = np.sqrt(np.einsum("fii->fi", expected.covariance))
        apart = (found.covariance - expected.covariance) / (sigma[:, :, None] * sigma[:, None])
        assert_allclose(apart[same], 0.0, atol=0.05)


class TestAnyRow:
    def test_a_range_without_bounds(self) -> None:
        """Noise alone is not detected."""
        array = ARRAYS["isotropic"]
        readings = np.random.default_rng(10).normal(scale=1e-9, size=(N_ROWS, array.n_channels))
        (rows,) = whitened_rows(array, readings, None, N_ROWS)
        (optima,) = SingleSourceSearch(array).optima(rows)
        found = single_source_columns(optima)
        assert_array_equal(found.ranges[:, 0, 0], np.tile([0.0, np.inf], (len(optima.of_row), 1)))
        assert np.isnan(found.ranges[:, 0, 1:]).all()
        assert not found.gaussian.any()

    def test_several_solutions(self) -> None:
        """Their weights raise the level within which 95 % of all of them are."""
        optima = optima_of(CASES["square 1 m"][0], "far")
        assert np.count_nonzero(np.bincount(optima.of_row) > 1) > 10
        found, expected = single_source_columns(optima), fit_columns(optima, np.ones(len(optima.rows), bool))
        assert_allclose(found.weight, expected.weight, atol=1e-6)
        assert np.count_nonzero((found.weight > 0.05) & (found.weight < 0.95)) > 10
        assert np.mean(same_ranges(found.ranges, expected.ranges)) > 0.9

    def test_singular(self) -> None:
        """Two sensors know six numbers of no source."""
        array = SensorArray(tuple(Sensor(f"s{i}", "vector", (float(i), 0.0, 0.0), 1e-9) for i in range(2)))
        (rows,) = whitened_rows(array, np.random.default_rng(1).normal(scale=1e-7, size=(1, 6)), None, 1)
        whole = optima_of(ARRAYS["isotropic"])
        optima = replace(whole, rows=rows, fits=whole.fits.rows(np.arange(1)), of_row=np.zeros(1, dtype=np.int64))
        found = single_source_columns(optima)
        assert np.isnan(found.covariance).all()
        assert_array_equal(found.weight, [0.0])

    def test_rows_without_any_fit(self) -> None:
        whole = optima_of(ARRAYS["isotropic"])
        none = np.arange(0)
        found = single_source_columns(replace(whole, fits=whole.fits.rows(none), of_row=none))
        assert found.covariance.shape == (0, 6, 6)


class TestIndependence:
    """A row has the same results whatever its block, its thread, and the lanes beside it."""

    @pytest.mark.parametrize("case", ["isotropic", "common field with a prior"])
    def test_of_threads_and_blocks(
        self, case: str, threads: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        optima = optima_of(ARRAYS[case], n_rows=150)
        expected = single_source_columns(optima)
        monkeypatch.setattr(refinement, "_CHANNELS_A_BLOCK", 0)
        for n_threads in (1, 2):
            threads(n_threads)
            for values, others in zip(single_source_columns(optima), expected, strict=True):
                assert_array_equal(values, others)
        of_77 = optima.of_row == 77
        alone = replace(
            optima,
            rows=optima.rows.select(np.array([77])),
            fits=optima.fits.rows(np.flatnonzero(of_77)),
            of_row=np.zeros(np.count_nonzero(of_77), dtype=np.int64),
        )
        for values, others in zip(single_source_columns(alone), expected, strict=True):
            n = values.shape[2] if values.ndim == 4 else None
            assert_array_equal(values, others[of_77][:, :, :n] if n else others[of_77])
