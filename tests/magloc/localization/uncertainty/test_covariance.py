"""What is known of the optima of one source: the compiled form against its readable twin."""

from __future__ import annotations

import numpy as np
import pytest

from arrays.array import SensorArray
from magloc.localization.search.single_source import SingleSourceSearch
from magloc.localization.uncertainty.covariance import known_of, known_of_one_compiled
from magloc.measurement.rows import whitened_rows
from tests.magloc.localization.search.test_candidates import regime


class TestCompiledForm:
    """Ends of ranges are read from the profile at a rise of 3.84 to 0.01, by two searches."""

    @pytest.mark.parametrize("name", ["product", "near"])
    @pytest.mark.parametrize("noise_fraction", [0.0, 0.003])
    def test_same_as_the_twin(self, name, noise_fraction):
        array, _, readings = regime(name, 150, np.random.default_rng(9))
        readings[:5] = np.random.default_rng(10).normal(scale=1e-9, size=(5, 12))  # nothing is detected
        readings[5:10, 3] += 3e-8  # a misfit
        array = SensorArray(array.sensors, noise_fraction=noise_fraction)
        (rows,) = whitened_rows(array, readings, None, 150)
        (optima,) = SingleSourceSearch(array).optima(rows)
        expected, known = known_of(optima, np.ones(len(optima.rows), bool)), known_of_one_compiled(optima)
        np.testing.assert_allclose(known.position_m, expected.position_m, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(known.moment_Am2, expected.moment_Am2, rtol=1e-12)
        np.testing.assert_allclose(known.weight, expected.weight, atol=1e-6)
        n = expected.ranges.shape[2]
        np.testing.assert_allclose(known.ranges[:, :, :n], expected.ranges, rtol=0.02, atol=0.02)
        assert np.isnan(known.ranges[:, :, n:]).all()
        np.testing.assert_array_equal(known.gaussian, expected.gaussian)
        sigma = np.sqrt(np.einsum("fii->fi", expected.covariance))
        correlation = (known.covariance - expected.covariance) / (sigma[:, :, None] * sigma[:, None])
        np.testing.assert_allclose(correlation, 0.0, atol=0.05)
        assert expected.gaussian.any()
        assert not expected.gaussian.all()
