"""Fixes by sensors whose carrier has fields of its own that the ambient one induces, in simulation.

A tetrahedron of 0.1 nT, or twelve scalar sensors, turns in the Earth's field; a matrix of random numbers for every
sensor, drawn anew for every source, makes fields of it and of its rate. The seeds are not chosen.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import magloc
from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from arrays.sensor import Sensor
from magloc.readings import Readings

EARTH_T = np.array([2e-5, 1e-6, 4.5e-5])
RATE_RAD_S = np.array([0.5, -0.3, 0.4])
INDUCED = {"induced_uncertainty": 4e-5}  # 2 nT of 49,000
EDDY = {"eddy_uncertainty_s": 1e-4}  # 3 nT


PLACES = np.random.default_rng(4).uniform(-0.8, 0.8, (12, 3)).tolist()
SCALARS = SensorArray(tuple(Sensor(f"s{i}", "scalar", tuple(place), 1e-10) for i, place in enumerate(PLACES)))


def array_of(kind, **stated) -> SensorArray:
    array = tetrahedron(1.2, noise_T=1e-10) if kind == "vector" else SCALARS
    return replace(array, sensors=tuple(replace(sensor, **stated) for sensor in array.sensors))


def simulated(array: SensorArray, n: int, seed: int):
    """Sources of 100 A·m² at 1.5 to 2.5 m in the array's axes, and rows of an array that turns about one axis."""
    rng = np.random.default_rng(seed)
    position, moment = rng.normal(size=(2, n, 3))
    position *= (rng.uniform(1.5, 2.5, n) / np.linalg.norm(position, axis=1))[:, None]
    moment *= (100.0 / np.linalg.norm(moment, axis=1))[:, None]
    time_s = 0.1 * np.arange(n)
    rotation = Rotation.from_rotvec(time_s[:, None] * RATE_RAD_S)
    ambient, before, after = (
        Rotation.from_rotvec((time_s + dt_s)[:, None] * RATE_RAD_S).inv().apply(EARTH_T) for dt_s in (0.0, -1e-4, 1e-4)
    )
    fields = np.stack([magloc.dipole.field(array.positions, *source) for source in zip(position, moment, strict=True)])
    for size, field in (
        (array.sensors[0].induced_uncertainty, ambient),
        (array.sensors[0].eddy_uncertainty_s, (after - before) / 2e-4),
    ):
        fields += size * np.einsum("nsij,nj->nsi", rng.normal(size=(n, array.n_sensors, 3, 3)), field)
    values = array.readings_of(fields + ambient[:, None])
    values += array.channel_noise_T * rng.normal(size=values.shape)
    readings = Readings(
        values, time_s=time_s, array_position_m=np.zeros((n, 3)), array_rotation=rotation, ambient_T=ambient
    )
    return rotation.apply(position), rotation.apply(moment), readings


def nees(fixes, position, moment):
    off = np.concatenate([fixes.position_m - position, fixes.moment_Am2 - moment], axis=1)
    return np.einsum("ni,nij,nj->n", off, np.linalg.inv(fixes.covariance), off) / 6.0


EXACT = {"induced_uncertainty": 0.0, "eddy_uncertainty_s": 0.0}


@pytest.mark.parametrize("kind", ["vector", "scalar"])
@pytest.mark.parametrize("stated", [INDUCED, EDDY], ids=["induced", "eddy currents"])
class TestFixes:
    def test_that_know_of_it_claim_their_errors(self, kind, stated):
        """The mean of 60 lies within 5 σ of that of χ²: 1 in 10⁶ fails by chance."""
        array = array_of(kind, **stated)
        position, moment, readings = simulated(array, 60, 6)
        fixes = magloc.locate(array, readings, body_length_m=0.0)
        assert abs(nees(fixes, position, moment).mean() - 1.0) < 5.0 * np.sqrt(2.0 / (6.0 * 60))
        assert not any(fixes.dropped_sensors)
        assert not fixes.misfit.any()

    def test_that_do_not_say_that_something_is_wrong(self, kind, stated):
        """A row is a misfit, or blames a sensor."""
        array = array_of(kind, **stated)
        _, _, readings = simulated(array, 20, 7)
        fixes = magloc.locate(array_of(kind, **EXACT), readings, body_length_m=0.0)
        assert np.mean([fix.misfit or bool(fix.dropped_sensors) for fix in fixes]) > 0.9
