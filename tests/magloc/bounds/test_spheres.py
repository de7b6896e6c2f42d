"""How far a source is found, over a sphere."""

from __future__ import annotations

import numpy as np
import pytest

from arrays.geometries import tetrahedron
from magloc.bounds.maps import CASES, BoundScenario
from magloc.bounds.spheres import bound_spheres, sphere_grid, with_detection_ranges
from magloc.chi_square import ChiSquareDetector
from magloc.detection.dipole_filter import DipoleFilter

SCENARIO = BoundScenario(tetrahedron(1.5, noise_T=1e-9), (30.0, 0.0, 40.0), n_moments=20)
DETECTOR = ChiSquareDetector(9)


@pytest.fixture(scope="module")
def spheres():
    return with_detection_ranges(bound_spheres(SCENARIO, [5.0], 30.0), SCENARIO, DETECTOR, 0.8)


class TestDetectionRanges:
    def test_where_the_energy_of_the_signal_is_that_required(self, spheres):
        matched = DipoleFilter(SCENARIO.array)
        directions = sphere_grid(spheres["elevation"].to_numpy(), spheres["azimuth"].to_numpy())
        places = SCENARIO.array.centroid + spheres["detection_range"].to_numpy()[..., None] * directions
        signals = matched.signal(places, SCENARIO.moment_Am2)
        energy = np.einsum("...c,...c->...", signals, signals)
        np.testing.assert_allclose(energy, DETECTOR.required_energy(0.8), rtol=1e-3)

    def test_shares_of_the_moments(self, spheres):
        """At the distance of 95 % of 20 moments 19 are found, at that of a half 10, at that of the worst all."""
        matched = DipoleFilter(SCENARIO.array)
        for case, count in (("_median", 10), ("_q95", 19), ("_worst", 20)):
            distance = float(spheres[f"detection_range{case}"].sel(elevation=30.0, azimuth=30.0))
            direction = sphere_grid(np.array([30.0]), np.array([30.0]))[0, 0]
            for factor, expected in ((1.0 - 1e-4, count), (1.0 + 1e-4, count - 1)):
                place = SCENARIO.array.centroid + factor * distance * direction
                signals = matched.signal(place, SCENARIO.moments_Am2)
                found = np.einsum("nc,nc->n", signals, signals) > DETECTOR.required_energy(0.8)
                assert found.sum() == expected

    def test_goes_all_the_way_round_and_says_what_it_is(self, spheres):
        for case in CASES:
            found = spheres[f"detection_range{case}"]
            np.testing.assert_array_equal(found.sel(azimuth=180.0), found.sel(azimuth=-180.0))
            assert found.attrs["units"] == "m"
        assert spheres.attrs["detection_probability"] == 0.8
