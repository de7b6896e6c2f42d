"""Fixes of a source whose moment is known, in simulation; those of a recording are in test_recordings.

| what | truth |
|---|---|
| position, covariance | simulated readings; the mean NEES lies within 5 σ of that of χ²: 1 in 10⁶ fails by chance |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import magloc
from arrays.array import SensorArray
from arrays.geometries import grid, square, tetrahedron
from magloc.localization.locator import fit_at_rest
from tests.plain_locator import plain_locator, random_sources

MODULUS_AM2 = 100.0
EARTH_T = (2e-5, 1e-6, 4.5e-5)


def sources(n: int, range_m: tuple[float, float], seed: int):
    """Places all around, and moments of one modulus."""
    rng = np.random.default_rng(seed)
    return *random_sources(rng, n, *range_m, MODULUS_AM2), rng


def readings_of(array: SensorArray, position, moment, rng):
    fields = np.stack([magloc.dipole.field(array.positions, p, m) for p, m in zip(position, moment, strict=True)])
    exact = array.readings_of(fields + array.ambient_fields)
    return exact + rng.normal(size=exact.shape) * array.channel_noise_T


def normalised_errors(fixes, position, moment):
    off = np.concatenate([fixes.position_m - position, fixes.moment_Am2 - moment], axis=1)
    return np.einsum("ni,nij,nj->n", off, np.linalg.inv(fixes.covariance), off)


def prior(value=MODULUS_AM2, sigma=2.0) -> magloc.SourcePrior:
    return magloc.SourcePrior(known_moment_Am2=value, known_moment_sigma_Am2=sigma)


class TestKnownModulus:
    @pytest.mark.parametrize(
        "array",
        [tetrahedron(1.5), replace(square(2.0, kind="scalar", noise_T=1e-11), ambient_T=EARTH_T)],
        ids=["vector", "scalar"],
    )
    def test_errors_are_those_of_the_covariance(self, array):
        if array.channel_is_scalar.any():
            array = SensorArray(
                tuple(
                    replace(s, id=f"{s.id}{i}", position_m=(s.position_m[0], s.position_m[1], float(i)))
                    for i in range(2)
                    for s in array.sensors
                ),
                ambient_T=EARTH_T,
            )
        position, moment, rng = sources(60, (3.0, 5.0), 3)
        moment = moment * rng.normal(1.0, 0.02, size=(60, 1))
        readings = readings_of(array, position, moment, rng)
        fixes = plain_locator(array, prior=prior()).fit_rows(readings)
        nees = normalised_errors(fixes, position, moment)
        assert fixes.solved.all()
        assert abs(nees.mean() / 6.0 - 1.0) < 5.0 * np.sqrt(2.0 / (6.0 * 60))

    def test_it_closes_the_valley_of_ranges(self):
        array = tetrahedron(1.5)
        position, moment, rng = sources(40, (7.0, 9.0), 5)
        readings = readings_of(array, position, moment, rng)
        unknown = magloc.locate(array, readings)
        known = magloc.locate(array, readings, prior=prior())

        def median_error(fixes):
            return np.median(np.linalg.norm(fixes.position_m - position, axis=1))

        assert median_error(known) < 0.5 * median_error(unknown)
        observable = [fix.best.source.range_observable for fix in known]
        assert np.mean(observable) > np.mean([fix.best.source.range_observable for fix in unknown]) + 0.2

    def test_chi2_is_that_of_the_readings_alone(self):
        array = tetrahedron(1.5)
        position, moment, rng = sources(3, (3.0, 4.0), 6)
        readings = readings_of(array, position, moment, rng)
        fixes = plain_locator(array, prior=prior(sigma=1e6)).fit_rows(readings)
        plain = plain_locator(array).fit_rows(readings)
        np.testing.assert_allclose(fixes.chi2, plain.chi2, rtol=1e-5)
        np.testing.assert_array_equal(fixes.dof, plain.dof)
        np.testing.assert_allclose(fixes.position_m, plain.position_m, atol=1e-6)

    @pytest.mark.slow
    @pytest.mark.parametrize("stated", [0.5, 1.5])
    def test_a_wrong_one_is_a_misfit_where_the_readings_tell(self, stated):
        array = tetrahedron(1.5)
        position, moment, rng = sources(15, (2.5, 3.5), 7)
        readings = readings_of(array, position, moment, rng)
        fixes = magloc.locate(array, readings, prior=prior(stated * MODULUS_AM2, 0.01 * MODULUS_AM2))
        consistent = normalised_errors(fixes, position, moment) < 40.0
        assert (consistent | fixes.misfit).all()
        assert fixes.misfit.mean() > 0.8

    def test_of_two_sources(self):
        array = grid(3, 3, 0.5, noise_T=1e-10)
        rng = np.random.default_rng(8)
        places = np.array([[0.0, 0.4, 0.8], [0.3, -0.6, 0.9]])
        moments = np.array([[0.0, 0.6, 0.8], [0.0, -0.8, 0.6]])
        fields = sum(magloc.dipole.field(array.positions, p, m) for p, m in zip(places, moments, strict=True))
        readings = array.readings_of(fields) + rng.normal(size=array.n_channels) * array.channel_noise_T
        known = magloc.SourcePrior(known_moment_Am2=1.0, known_moment_sigma_Am2=0.02)
        best = magloc.locate(array, readings, sources=2, prior=known)[0].best
        found = np.array([source.position_m for source in best.sources])
        order = np.argsort(-found[:, 1])
        np.testing.assert_allclose(found[order], places, atol=0.02)
        assert best.n_known == 2

    def test_at_a_known_place(self):
        array = tetrahedron(1.5)
        position, moment, rng = sources(40, (5.0, 6.0), 9)
        moment = moment * rng.normal(1.0, 0.02, size=(40, 1))
        readings = readings_of(array, position, moment, rng)
        fixes = plain_locator(array, position_m=position, prior=prior()).fit_rows(readings)
        off = fixes.moment_Am2 - moment
        nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(fixes.covariance), off)
        assert abs(nees.mean() / 3.0 - 1.0) < 5.0 * np.sqrt(2.0 / (3.0 * 40))

    def test_from_several_rows_of_a_source_at_rest(self):
        array = tetrahedron(1.5)
        position, moment, rng = sources(1, (6.0, 7.0), 10)
        origins = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
        readings = np.concatenate([readings_of(array, position - origin, moment, rng) for origin in origins])
        turns = np.broadcast_to(np.eye(3), (2, 3, 3))
        loose = fit_at_rest(array, readings, origins, turns).best
        tight = fit_at_rest(array, readings, origins, turns, prior=prior()).best
        assert np.linalg.norm(tight.moment_Am2) == pytest.approx(MODULUS_AM2, abs=8.0)
        assert np.trace(tight.covariance[:3, :3]) < np.trace(loose.covariance[:3, :3])


class TestKnownVector:
    def test_errors_are_those_of_the_covariance(self):
        array = tetrahedron(1.5)
        position, _, rng = sources(40, (5.0, 8.0), 11)
        stated = np.array([60.0, 50.0, 60.0])
        moment = stated + rng.normal(size=(40, 3))
        readings = readings_of(array, position, moment, rng)
        fixes = plain_locator(array, prior=prior(tuple(stated.tolist()), 1.0)).fit_rows(readings)
        nees = normalised_errors(fixes, position, moment)
        assert abs(nees.mean() / 6.0 - 1.0) < 5.0 * np.sqrt(2.0 / (6.0 * 40))
        assert {fix.best.n_known for fix in fixes} == {3}


class TestRefused:
    @pytest.mark.parametrize("value", [0.0, -1.0, (0.0, 0.0, 0.0), (1.0, 2.0)])
    def test_a_moment_that_is_none(self, value):
        with pytest.raises(ValueError, match="known_moment_Am2 must be a positive number"):
            magloc.SourcePrior(known_moment_Am2=value)

    def test_a_sigma_that_is_none(self):
        with pytest.raises(ValueError, match="known_moment_sigma_Am2 must be positive"):
            magloc.SourcePrior(known_moment_Am2=1.0, known_moment_sigma_Am2=0.0)

    def test_a_sigma_alone(self):
        with pytest.raises(ValueError, match="must come with known_moment_Am2"):
            magloc.SourcePrior(known_moment_sigma_Am2=1.0)
