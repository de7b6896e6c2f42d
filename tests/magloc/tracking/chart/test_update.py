"""Updates in the chart: what is likely, and where the iteration stops."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from magloc.tracking import row_filter
from magloc.tracking.coordinates import Chart
from magloc.tracking.motion import RandomWalk
from magloc.tracking.row_filter import Gaussians
from magloc.tracking.rows import Row
from magloc.tracking.tracker import Tracker
from tests.passing_source import ARRAY, MOMENT, POSITION

FloatArray = NDArray[np.float64]
# Three sensors have six differences: they determine a source, and no combination of them is left over.
THREE = ARRAY.subset(["s1", "s2", "s3"])
SOURCE = np.concatenate([POSITION, MOMENT])


def far_update(shift: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Evidence of readings a shift (6,) of standard numbers from a prediction, its h and J, and the readings."""
    measurements = Tracker(THREE, RandomWalk(1e-6, 1e-6)).measurements
    centroid, radius = THREE.centroid, THREE.circumradius
    chart = Chart.at(SOURCE[None], centroid, radius)
    strength = float(np.linalg.norm(MOMENT)) / float(chart.length[0]) ** 4
    S = np.diag([0.1, 0.1, 0.1, *[0.1 * strength] * 3])
    there = chart.retract((S @ shift)[None])[0]
    blank = measurements.of(Row(0.0, np.zeros(THREE.n_channels)))
    h = blank.predict_source(SOURCE)
    J = blank.directional_derivative(SOURCE, chart.jacobian(np.zeros((1, 6)))[0]) @ S
    readings = np.linalg.lstsq(blank.transform, blank.predict_source(there))[0]
    measurement = measurements.of(Row(0.0, readings))
    gaussian = Gaussians(SOURCE[None], S[None])
    found = row_filter.update(gaussian, measurement.kernel_rows, bends=np.ones(1, dtype=bool))
    assert found.converged.all()
    return float(found.log_evidence[0]), h, J, measurement.z


class TestEvidenceOfABentPrediction:
    @pytest.mark.parametrize("seed", range(4))
    def test_is_that_of_the_gaussian_in_what_is_measured(self, seed: int) -> None:
        """A prediction that is Gaussian in h makes readings Gaussian, however far they lead: N(h, 1 + J Jᵀ)."""
        shift = np.random.default_rng(seed).normal(size=6)
        found, h, J, z = far_update(shift)
        expected = multivariate_normal.logpdf(z, h, np.eye(6) + J @ J.T) + 3.0 * math.log(2.0 * math.pi)
        assert found == pytest.approx(float(expected), abs=0.05)
