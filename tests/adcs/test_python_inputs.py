"""Masked readings are missing ones, durations and dates are times, and times that are not finite are refused."""

from __future__ import annotations

import numpy as np
import pytest

import adcs

N = 300
MASK = np.arange(N)[:, None] % 50 == np.array([7, 7, 7])


def readings() -> list[np.ndarray]:
    """Of an inertial unit that stands still."""
    rng = np.random.default_rng(0)
    means = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 9.81], [0.0, 2e-5, -4e-5]])
    return [mean + sigma * rng.standard_normal((N, 3)) for mean, sigma in zip(means, (1e-3, 1e-2, 1e-7), strict=True)]


class TestTelemetry:
    def test_masks_and_durations(self) -> None:
        given = np.ma.MaskedArray(np.ones((4, 3)), np.eye(4, 3, dtype=bool))
        telemetry = adcs.Telemetry(np.arange(4).astype("m8[s]"), gyro_rad_s=given)
        np.testing.assert_array_equal(telemetry.time_s, np.arange(4.0))
        np.testing.assert_array_equal(np.isnan(telemetry.gyro_rad_s).all(axis=1), [True, True, True, False])

    @pytest.mark.parametrize("times", [[0.0, np.nan], [0.0, np.inf], np.array(["2026-01-01", "2026-01-02"], "M8[s]")])
    def test_times_that_are_none(self, times: object) -> None:
        with pytest.raises(ValueError, match=r"^Input time_s must be (finite|seconds or durations)"):
            adcs.Telemetry(times)


class TestInertialUnit:
    def test_masks_and_dates(self) -> None:
        """As NaN, and as seconds; since 1970 these have steps of 0.24 µs, of which 1e-5 rad come."""
        steps = np.arange(N) * np.timedelta64(10, "ms")
        hidden = [np.where(MASK, np.nan, values) for values in readings()]
        masked = [np.ma.MaskedArray(values, MASK) for values in readings()]
        expected = adcs.inertial_magnetic_filter(np.arange(N) / 100.0, *hidden)
        found = adcs.inertial_magnetic_filter(np.datetime64("2026-05-12T09:14:03") + steps, *masked)
        np.testing.assert_allclose(found.q, expected.q, atol=1e-4)

    def test_times_that_are_none(self) -> None:
        with pytest.raises(ValueError, match="Input time_s must ascend"):
            adcs.inertial_magnetic_filter(np.full(N, np.nan), *readings())
