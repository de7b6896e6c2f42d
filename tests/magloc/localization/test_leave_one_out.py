"""Fits without some sensors, and what a deletion does to a fit.

| what | who checks it |
|---|---|
| weighted problem | whitening of an array whose sensors have that noise |
| fall of χ² | refinement of the rows whitened without the sensor's channels |
| what the others check | leverage of scipy's orthonormal basis of the derivatives by central differences |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

from arrays.array import SensorArray
from arrays.geometries import cube, grid
from magloc.fields import dipole
from magloc.localization.fit.gauss_newton import refine
from magloc.localization.leave_one_out import chi2_falls_without_sensors, weight_channels
from magloc.measurement.rows import whitened_model, whitenings_of

AMBIENT = np.array([2e-5, 0.0, 4.5e-5])
NOISE = 1e-9
CUBE = cube(1.0, "vector", NOISE)


def array_of(kinds, common_field_T):
    """The cube of vector sensors, of eight scalar ones and eight more, or both kinds, in the ambient field."""
    scalar = tuple(replace(s, id=f"t{s.id}") for s in cube(1.0, "scalar", NOISE).sensors)
    more = tuple(replace(s, id=f"m{s.id}", position_m=(1.3 * s.position_m[0] + 0.3, *s.position_m[1:])) for s in scalar)
    sensors = {"vector": CUBE.sensors, "scalar": scalar + more, "mixed": CUBE.sensors[:5] + scalar[5:]}[kinds]
    return SensorArray(sensors, ambient_T=tuple(AMBIENT.tolist()), common_field_T=common_field_T)


class TestFallsWithoutSensors:
    """First order is exact where the noise bends the fit by little: a source is seen at 10,000 σ."""

    @pytest.mark.parametrize("common_field_T", [None, 3e-9])
    @pytest.mark.parametrize("kinds", ["vector", "scalar", "mixed"])
    @pytest.mark.parametrize("free_position", [True, False])
    def test_refit_without_the_channels(self, kinds, common_field_T, free_position):
        rng = np.random.default_rng(21)
        array = array_of(kinds, common_field_T)
        place, moment = np.array([1.2, 0.7, -0.9]), np.array([300.0, -200.0, 400.0])
        clean = array.readings_of(AMBIENT + dipole.field(array.positions, place, moment))
        readings = (clean + NOISE * rng.normal(size=clean.shape))[None]
        free = np.full((1, 3), free_position)

        def fitted(mask, q, mu):
            problem, raw = whitened_model(array, mask, readings, whitenings_of(array, mask, readings), None)
            return problem, raw, refine(problem, problem.whiten(raw), q, mu, free=free)

        every = np.ones(array.n_channels, dtype=bool)
        start, _ = whitened_model(array, every, readings, whitenings_of(array, every, readings), None)
        q = start.homogeneous(place[None, None])
        problem, raw, fit = fitted(every, q, start.scaled_moment(q, moment[None, None]))
        falls, checked = chi2_falls_without_sensors(
            problem, raw, fit.q, fit.mu, array.sensor_channels, free_position=free_position
        )
        for sensor in range(array.n_sensors):
            _, _, without = fitted(every & (array.channel_sensor != sensor), fit.q, fit.mu)
            assert_allclose(falls[0, sensor], fit.chi2[0] - without.chi2[0], rtol=0.01, atol=1e-3)
        assert np.all((checked > 0.0) & (checked < 1.0))

    def test_two_sources(self):
        rng = np.random.default_rng(22)
        array = grid(4, 4, 0.5, noise_T=NOISE)
        place = array.centroid + np.array([[-0.6, 0.1, -1.0], [0.7, -0.3, -1.3]])
        moment = np.array([[150.0, 20.0, -90.0], [40.0, 130.0, 100.0]])
        readings = array.readings_of(dipole.total_field(array.positions, place, moment))[None]
        readings += NOISE * rng.normal(size=readings.shape)
        every = np.ones(array.n_channels, dtype=bool)
        problem, raw = whitened_model(array, every, readings, whitenings_of(array, every, readings), None)
        q = problem.homogeneous(place)[None]
        fit = refine(problem, problem.whiten(raw), q, problem.scaled_moment(q, moment[None]))
        falls, _ = chi2_falls_without_sensors(problem, raw, fit.q, fit.mu, array.sensor_channels)
        for sensor in range(array.n_sensors):
            mask = array.channel_sensor != sensor
            other, other_raw = whitened_model(array, mask, readings, whitenings_of(array, mask, readings), None)
            without = refine(other, other.whiten(other_raw), fit.q, fit.mu)
            assert_allclose(falls[0, sensor], fit.chi2[0] - without.chi2[0], rtol=0.01, atol=1e-3)

    def test_what_the_others_check(self):
        """One less the largest share of a sensor's readings that all unknowns together can follow."""
        array = grid(6, 5, 0.08, noise_T=NOISE)
        place, moment = array.positions[[14]] + [[0.01, 0.0, -0.03]], np.array([[0.3, -0.1, 0.2]])

        def clean(x):
            return array.readings_of(dipole.field(array.positions, x[:3], x[3:]))

        x = np.concatenate([place[0], moment[0]])
        steps = 1e-6 * np.eye(6)
        columns = [(clean(x + step) - clean(x - step)) / 2e-6 for step in steps]
        columns += [np.tile(axis, array.n_sensors) for axis in np.eye(3)]
        basis = scipy.linalg.orth(np.array([column / np.linalg.norm(column) for column in columns]).T)
        blocks = basis.reshape(array.n_sensors, 3, 9)
        expected = 1.0 - np.linalg.norm(blocks, ord=2, axis=(1, 2)) ** 2
        every, readings = np.ones(array.n_channels, dtype=bool), clean(x)[None]
        problem, raw = whitened_model(array, every, readings, whitenings_of(array, every, readings), None)
        q = problem.homogeneous(place)[None]
        mu = problem.scaled_moment(q, moment[None])
        _, checked = chi2_falls_without_sensors(problem, raw, q, mu, array.sensor_channels)
        assert_allclose(checked[0], expected, atol=1e-5)
        assert checked[0, 14] < 0.01
        assert np.median(checked) > 0.9


class TestWeightedProblem:
    """A weight divides the variance: χ² is that of an array whose sensors are as noisy as that."""

    @pytest.mark.parametrize("common_field_T", [None, 3e-9, 1e-6])
    @pytest.mark.parametrize("kinds", ["vector", "scalar", "mixed"])
    def test_chi2(self, kinds, common_field_T):
        rng = np.random.default_rng(14)
        array = array_of(kinds, common_field_T)
        weight = rng.uniform(0.01, 1.0, array.n_sensors)
        noisier = replace(
            array,
            sensors=tuple(
                replace(s, noise_T=s.noise_T / np.sqrt(w)) for s, w in zip(array.sensors, weight, strict=True)
            ),
        )
        fields = AMBIENT + 1e-8 * rng.normal(size=(4, array.n_sensors, 3))
        readings = array.readings_of(fields)
        mask = np.ones(array.n_channels, dtype=bool)
        problem, raw = whitened_model(array, mask, readings, whitenings_of(array, mask, readings), None)
        per_channel = np.broadcast_to(weight[array.channel_sensor], raw.shape)
        lighter, lighter_raw = weight_channels(problem, raw, per_channel)
        other, other_raw = whitened_model(noisier, mask, readings, whitenings_of(noisier, mask, readings), None)
        q = problem.homogeneous(np.array([[[2.0, 1.0, 0.5]]] * 4))
        mu = problem.scaled_moment(q, rng.normal(size=(4, 1, 3)))
        chi2 = [
            np.sum((p.whiten(y) - p.predict(p.source_fields(q, mu))) ** 2, axis=1)
            for p, y in ((lighter, lighter_raw), (other, other_raw))
        ]
        assert_allclose(chi2[0], chi2[1], rtol=1e-6)

    def test_weights_of_one_change_nothing(self):
        array = replace(CUBE, common_field_T=1e-8)
        clean = AMBIENT[np.arange(24) % 3] + 1e-8 * np.random.default_rng(15).normal(size=(2, 24))
        mask = np.ones(24, dtype=bool)
        problem, raw = whitened_model(array, mask, clean, whitenings_of(array, mask, clean), None)
        same, same_raw = weight_channels(problem, raw, np.ones_like(raw))
        assert_allclose(same.whiten(same_raw), problem.whiten(raw), rtol=1e-9, atol=1e-9)
