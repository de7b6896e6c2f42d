"""Bounds of a body's pose: against errors of fits, and what the limits mean."""

from __future__ import annotations

import numpy as np
import pytest

from magloc.bodies.locator import locate_body
from magloc.bounds.bodies import body_bounds
from tests.magloc.bodies.devices import hall_ring, knob, readings_of


def test_bounds_are_the_covariances_of_fixes() -> None:
    array, body = hall_ring(4), knob(moment_sigma_Am2=0.0005)
    bounds = body_bounds(array, body, 50)
    readings = readings_of(array, body, bounds.position_m, bounds.R, np.random.default_rng(60_30))
    poses = locate_body(array, body, readings)
    ratio = np.sqrt(np.linalg.det(poses.covariance[:, 0]) / np.linalg.det(bounds.covariance))
    assert np.median(ratio) == pytest.approx(1.0, rel=0.05)


def test_more_sensors_and_exact_moments_tighten_the_bounds() -> None:
    sigma = [
        np.median(body_bounds(array, body, 200).sigma_position_m)
        for array, body in (
            (hall_ring(4), knob(moment_sigma_Am2=0.005)),
            (hall_ring(4), knob()),
            (hall_ring(8), knob()),
        )
    ]
    assert sigma[0] > sigma[1] > sigma[2]
    assert set(body_bounds(hall_ring(4), knob(), 20).json()["sigma_position_m"]) == {"median", "q95", "worst_sampled"}
