"""The exact model of any number of dipoles, and its refinement.

| what | who checks it |
|---|---|
| predictions, χ² | magpylib |
| Jacobians | scipy.differentiate |
| the optimum | scipy.optimize.least_squares on magpylib's field |
| covariance | scipy.differentiate on magpylib's field; scatter of the fixes: test_locator, test_multi_source |

"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from arrays.array import SensorArray
from arrays.differences import decorrelated_differences
from arrays.geometries import tetrahedron
from arrays.sensor import Sensor
from magloc.localization.fit.gauss_newton import (
    JointFits,
    covariances,
    damped_gauss_newton,
    fit_moments,
    refine,
    refine_moments,
    tangents,
)
from magloc.measurement.rows import whitened_model, whitenings_of
from magloc.measurement.whitened import WhitenedModel
from tests import oracles
from tests.arrays.test_differences import random_array

SEEDS = st.integers(0, 2**32 - 1)
AMBIENT = (2e-5, -1e-6, 4.5e-5)
KINDS = ["vector", "scalar", "scalar in ambient", "mixed", "mixed in ambient"]


def array_of(kind, seed=0, n=14):
    """Turned, unequal and offset sensors within a metre or two of the origin."""
    kinds = {"vector": ("vector",), "scalar": ("scalar",), "mixed": ("vector", "scalar")}[kind.split(" ")[0]]
    array = random_array(seed, n, kinds=kinds)
    return replace(array, ambient_T=AMBIENT) if "ambient" in kind else array


def scalar_cloud(seed, ambient_T=AMBIENT):
    """Twelve scalar sensors of 0.01 nT anywhere within 1.5 m along every axis."""
    places = np.random.default_rng(seed).uniform(-1.5, 1.5, (12, 3))
    return SensorArray(
        tuple(Sensor(f"s{i}", "scalar", tuple(place), 1e-11) for i, place in enumerate(places)), ambient_T=ambient_T
    )


def random_sources(rng, n_rows, n_sources, nearest=3.0, farthest=5.0, moment=300.0):
    """Positions and moments (n, K, 3), every source in a sector of its own around z so that all are told apart."""
    sector = 2.0 * np.pi / n_sources
    angle = sector * (np.arange(n_sources) + rng.uniform(-0.25, 0.25, (n_rows, n_sources)))
    height = rng.uniform(-0.5, 0.5, (n_rows, n_sources))
    flat = np.sqrt(1.0 - height**2)
    direction = np.stack([flat * np.cos(angle), flat * np.sin(angle), height], axis=-1)
    m = rng.normal(size=(n_rows, n_sources, 3))
    m *= moment / np.linalg.norm(m, axis=-1, keepdims=True)
    return direction * rng.uniform(nearest, farthest, (n_rows, n_sources, 1)), m


def magpylib_readings(array, positions, moments):
    """Noise-free raw readings (C,) of dipoles (K, 3), their field by magpylib."""
    fields = np.array(array.ambient_fields)
    for position, moment in zip(positions, moments, strict=True):
        fields = fields + oracles.magpylib_field(array.positions, position, moment)
    return array.readings_of(fields)


def noisy_readings(array, positions, moments, rng):
    """Noisy readings (n, C) of sources (n, K, 3)."""
    clean = np.stack([magpylib_readings(array, p, m) for p, m in zip(positions, moments, strict=True)])
    return clean + rng.normal(size=clean.shape) * array.channel_noise_T


def problem_of(array, readings, ambient=None):
    """Joint problem and whitened readings of rows (n, C) that miss the same channels."""
    mask = np.isfinite(readings[0])
    problem, raw = whitened_model(array, mask, readings, whitenings_of(array, mask, readings), ambient)
    return problem, problem.whiten(raw)


class Drawn(NamedTuple):
    """Sources drawn at random, noisy readings of them, and the joint problem and whitened readings of these."""

    problem: WhitenedModel
    y: np.ndarray
    p: np.ndarray
    m: np.ndarray
    readings: np.ndarray
    rng: np.random.Generator


def drawn(array, seed, n_rows, n_sources, *between):
    rng = np.random.default_rng(seed)
    p, m = random_sources(rng, n_rows, n_sources, *between)
    readings = noisy_readings(array, p, m, rng)
    return Drawn(*problem_of(array, readings), p, m, readings, rng)


def whitened_residuals(array, readings, positions, moments):
    """Decorrelated differences of one row minus those of magpylib's dipoles, over their standard deviations."""
    differences = decorrelated_differences(array, np.isfinite(readings))
    residual = np.nan_to_num(readings - magpylib_readings(array, positions, moments))
    return differences.transform @ residual / np.sqrt(differences.variance)


def chi2_by_magpylib(array, readings, positions, moments):
    return float(np.sum(whitened_residuals(array, readings, positions, moments) ** 2))


def scipy_optimum(array, readings, positions, moments):
    """χ², positions and moments of scipy's local optimum from a start, the field by magpylib."""
    size = np.linalg.norm(moments)

    def residual(x):
        p, m = x.reshape(2, -1, 3)
        return whitened_residuals(array, readings, p, size * m)

    start = np.concatenate([positions.ravel(), moments.ravel() / size])
    found = scipy.optimize.least_squares(
        residual, start, jac="3-point", method="lm", x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12
    )
    p, m = found.x.reshape(2, -1, 3)
    return 2.0 * found.cost, p, size * m


def refined_from(problem, y, positions, moments, **options):
    """Refinement from positions and moments (n, K, 3) in SI units."""
    q = problem.homogeneous(positions)
    return refine(problem, y, q, problem.scaled_moment(q, moments), **options)


def chi2_at(problem, y, q, mu):
    return np.sum((y - problem.predict(problem.source_fields(q, mu))) ** 2, axis=-1)


class TestPredictions:
    """χ² is that of the decorrelated differences, whatever the sensors and however many the sources."""

    @given(SEEDS, st.sampled_from(KINDS), st.integers(1, 3))
    @settings(max_examples=30, deadline=None)
    def test_chi2_of_magpylib_fields(self, seed, kind, n_sources):
        array = array_of(kind, seed)
        rng = np.random.default_rng(seed)
        p, m = random_sources(rng, 1, n_sources)
        readings = noisy_readings(array, p, m, rng) + 1e-8 * rng.normal(size=array.n_channels)
        problem, y = problem_of(array, readings)
        q = problem.homogeneous(p)
        chi2 = chi2_at(problem, y, q, problem.scaled_moment(q, m))
        # Moduli of 50 µT with a noise of 0.3 nT cancel to 1e-10 of the noise, squared against some 1e3.
        assert_allclose(chi2[0], chi2_by_magpylib(array, readings[0], p[0], m[0]), rtol=1e-7)

    def test_a_prior_of_the_common_field(self):
        array = replace(array_of("vector", 3), common_field_T=3e-9)
        problem, y, p, m, readings, *_ = drawn(array, 3, 1, 2)
        q = problem.homogeneous(p)
        chi2 = chi2_at(problem, y, q, problem.scaled_moment(q, m))[0]
        assert_allclose(chi2, chi2_by_magpylib(array, readings[0], p[0], m[0]), rtol=1e-9)

    def test_missing_channels_count_nothing(self):
        array = array_of("mixed in ambient", 5)
        rng = np.random.default_rng(5)
        p, m = random_sources(rng, 2, 2)
        readings = noisy_readings(array, p, m, rng)
        readings[:, [0, 3, 8]] = np.nan
        problem, y = problem_of(array, readings)
        q = problem.homogeneous(p)
        expected = [chi2_by_magpylib(array, *row) for row in zip(readings, p, m, strict=True)]
        assert_allclose(chi2_at(problem, y, q, problem.scaled_moment(q, m)), expected, rtol=1e-7)

    def test_ambient_field_of_every_row(self):
        array = array_of("scalar", 6)
        rng = np.random.default_rng(6)
        p, m = random_sources(rng, 4, 2)
        ambient = 3e-5 * rng.normal(size=(4, 3))
        rows = [replace(array, ambient_T=tuple(field)) for field in ambient]
        readings = np.concatenate([noisy_readings(row, p[i : i + 1], m[i : i + 1], rng) for i, row in enumerate(rows)])
        problem, y = problem_of(array, readings, ambient)
        q = problem.homogeneous(p)
        expected = [chi2_by_magpylib(*row) for row in zip(rows, readings, p, m, strict=True)]
        assert_allclose(chi2_at(problem, y, q, problem.scaled_moment(q, m)), expected, rtol=1e-6)


class TestCoordinates:
    @given(SEEDS)
    @settings(max_examples=20, deadline=None)
    def test_positions_and_moments_come_back(self, seed):
        array = array_of("mixed", seed)
        p, m = random_sources(np.random.default_rng(seed), 3, 2)
        problem, _ = problem_of(array, np.zeros((3, array.n_channels)))
        q = problem.homogeneous(p)
        assert_allclose(np.linalg.norm(q, axis=-1), 1.0, rtol=1e-15)
        for same in (q, -q):
            assert_allclose(problem.position(same), p, rtol=1e-12)
            assert_allclose(problem.moment(same, problem.scaled_moment(q, m)), m, rtol=1e-12)

    @pytest.mark.parametrize("kind", KINDS)
    def test_q_and_minus_q_are_the_same_source(self, kind):
        problem, y, p, m, *_ = drawn(array_of(kind, 7), 7, 3, 2)
        q = problem.homogeneous(p)
        mu = problem.scaled_moment(q, m)
        assert_allclose(problem.source_fields(-q, mu), problem.source_fields(q, mu), rtol=1e-12)
        start = problem.homogeneous(1.05 * p)
        one, other = refine(problem, y, start, mu), refine(problem, y, -start, mu)
        assert_allclose(other.chi2, one.chi2, rtol=1e-6)
        assert_allclose(problem.position(other.q), problem.position(one.q), rtol=1e-6)

    @given(SEEDS)
    @settings(max_examples=20, deadline=None)
    def test_tangents_are_orthonormal_and_the_third_changes_the_range_alone(self, seed):
        q = np.random.default_rng(seed).normal(size=(5, 4))
        q /= np.linalg.norm(q, axis=-1, keepdims=True)
        frame = np.concatenate([q[..., None], tangents(q)], axis=-1)
        assert_allclose(frame.swapaxes(-1, -2) @ frame, np.broadcast_to(np.eye(4), (5, 4, 4)), atol=1e-14)
        along = tangents(q)[:, :3, 2]
        assert_allclose(np.cross(along, q[:, :3]), np.zeros((5, 3)), atol=1e-14)

    @pytest.mark.parametrize("kind", KINDS)
    def test_infinity_is_an_ordinary_point(self, kind):
        """A source infinitely far away has a uniform field: predicted as nothing but its share in the moduli."""
        problem, _, p, m, *_ = drawn(array_of(kind, 8), 8, 2, 1)
        mu = problem.scaled_moment(problem.homogeneous(p), m)
        fields = []
        for s in (0.0, 1e-9):
            q = np.concatenate([p, np.full((2, 1, 1), s)], axis=-1) / np.linalg.norm(p, axis=-1, keepdims=True)
            fields.append(problem.source_fields(q, mu))
        assert_allclose(fields[0], np.broadcast_to(fields[0][:, :1], fields[0].shape), rtol=1e-12)
        assert_allclose(fields[1], fields[0], rtol=1e-6)

    def test_a_start_far_away_comes_back(self):
        problem, y, p, m, *_ = drawn(array_of("vector", 8), 8, 5, 1)
        far = problem.homogeneous(30.0 * p)
        fits = refine(problem, y, far, fit_moments(problem, y, far))
        best = refined_from(problem, y, p, m)
        assert_allclose(fits.chi2, best.chi2, rtol=1e-6)


class TestJacobians:
    """Derivatives of the predictions, by scipy's differences of order 8."""

    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize("n_sources", [1, 2])
    def test_along_tangents_and_moments(self, kind, n_sources):
        problem, _, p, m, *_ = drawn(array_of(kind, 11), 11, 1, n_sources)
        q = problem.homogeneous(p)
        mu = problem.scaled_moment(q, m)
        tangent = tangents(q)

        def predicted(x):
            flat = x.reshape(-1, 2, n_sources, 3)
            moved = q + (tangent @ flat[:, 0, ..., None])[..., 0]
            moments = mu + np.linalg.norm(mu) * flat[:, 1]
            at = problem.rows(np.zeros(len(flat), dtype=np.intp))
            return at.predict(at.source_fields(moved, moments)).reshape(*x.shape[:-1], -1)

        expected = oracles.derivative(predicted, np.zeros(6 * n_sources), 0.05)
        gain = problem.linear_gain(problem.source_fields(q, mu))
        by_position = problem.position_jacobian(q, mu, gain, tangent)[0]
        by_moment = problem.moment_jacobian(q, gain)[0] * np.linalg.norm(mu)
        scale = np.abs(expected).max(axis=0)
        assert_allclose(np.concatenate([by_position, by_moment], axis=-1) / scale, expected / scale, atol=1e-7)


class TestMoments:
    """Moments at known places."""

    def test_linear_channels_by_least_squares(self):
        array = array_of("vector", 12)
        problem, y, p, _, readings, *_ = drawn(array, 12, 3, 2)
        q = problem.homogeneous(p)
        moments = problem.moment(q, fit_moments(problem, y, q))
        for i in range(3):
            columns = [
                whitened_residuals(array, array.channel_offset_T, p[i, k : k + 1], -axis[None])
                for k in range(2)
                for axis in np.eye(3)
            ]
            data = whitened_residuals(array, readings[i], p[i], np.zeros((2, 3)))
            expected, *_ = np.linalg.lstsq(np.stack(columns, axis=-1), data)
            assert_allclose(moments[i].ravel(), expected, rtol=1e-6, atol=1e-6 * 300.0)

    @pytest.mark.parametrize("kind", ["scalar", "scalar in ambient", "mixed"])
    def test_moduli_by_scipy_from_the_same_start(self, kind):
        array = array_of(kind, 13)
        problem, y, p, m, readings, rng = drawn(array, 13, 4, 1)
        q = problem.homogeneous(p)
        start = m + 30.0 * rng.normal(size=m.shape)
        fits = refine_moments(problem, y, q, problem.scaled_moment(q, start))
        found = problem.moment(fits.q, fits.mu)
        assert_allclose(problem.position(fits.q), p, rtol=1e-12)
        for i in range(4):
            best = scipy.optimize.least_squares(
                lambda x, i=i: whitened_residuals(array, readings[i], p[i], x[None]), start[i, 0], jac="3-point"
            )
            assert fits.chi2[i] == pytest.approx(2.0 * best.cost, rel=1e-6, abs=1e-5)
            covariance = np.linalg.inv(best.jac.T @ best.jac)
            assert_allclose(found[i, 0], best.x, atol=1e-3 * np.sqrt(np.trace(covariance)))


class TestOptimum:
    """The refinement ends where scipy ends from the same start."""

    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize(("n_sources", "n"), [(1, 3), (2, 1), pytest.param(2, 3, marks=pytest.mark.slow)])
    def test_scipy_on_magpylib_fields(self, kind, n_sources, n):
        array = array_of(kind, 21, 16 if "vector" in kind else 22)
        problem, y, p, m, readings, rng = drawn(array, 21, n, n_sources)
        start_p, start_m = p + 0.05 * rng.normal(size=p.shape), m + 10.0 * rng.normal(size=m.shape)
        fits = refined_from(problem, y, start_p, start_m)
        position, moment = problem.position(fits.q), problem.moment(fits.q, fits.mu)
        assert fits.converged.all()
        for i in range(n):
            chi2, found_p, found_m = scipy_optimum(array, readings[i], start_p[i], start_m[i])
            assert fits.chi2[i] == pytest.approx(chi2, rel=1e-5, abs=1e-4)
            assert_allclose(position[i], found_p, rtol=1e-3)
            assert_allclose(moment[i], found_m, atol=1e-3 * 300.0)

    @given(SEEDS, st.sampled_from(KINDS), st.integers(1, 2), st.integers(1, 8))
    @settings(max_examples=40, deadline=None)
    def test_chi2_never_rises(self, seed, kind, n_sources, max_iterations):
        """From anywhere, converged or not."""
        problem, y, _, m, _, rng = drawn(array_of(kind, seed), seed, 6, n_sources)
        q = rng.normal(size=(6, n_sources, 4))
        q /= np.linalg.norm(q, axis=-1, keepdims=True)
        mu = problem.scaled_moment(q, 300.0 * rng.normal(size=m.shape))
        before = chi2_at(problem, y, q, mu)
        fits = refine(problem, y, q, mu, max_iterations=max_iterations)
        after = chi2_at(problem, y, fits.q, fits.mu)
        assert (after <= before * (1.0 + 1e-12)).all()
        assert_allclose(fits.chi2[fits.converged], after[fits.converged], rtol=1e-7, atol=1e-6)

    def test_iterations_that_run_out_are_no_optimum(self):
        problem, y, p, m, *_ = drawn(array_of("vector", 22), 22, 5, 1)
        fits = refined_from(problem, y, 2.0 * p, m, max_iterations=1)
        assert np.isinf(fits.chi2).all()
        assert not fits.converged.any()
        assert (fits.iterations == 1).all()

    def test_starts_are_left_as_they_are(self):
        problem, y, p, m, *_ = drawn(array_of("vector", 23), 23, 2, 1)
        q = problem.homogeneous(1.2 * p)
        mu = problem.scaled_moment(q, m)
        before = q.copy(), mu.copy()
        refine(problem, y, q, mu)
        assert np.array_equal(q, before[0])
        assert np.array_equal(mu, before[1])

    @pytest.mark.parametrize("kind", KINDS)
    def test_a_batch_gives_what_single_fits_give(self, kind):
        array = array_of(kind, 24)
        problem, y, p, m, _, rng = drawn(array, 24, 6, 2)
        start = p + 0.1 * rng.normal(size=p.shape)
        together = refined_from(problem, y, start, m)
        for i in range(6):
            alone = refined_from(problem.rows(np.array([i])), y[i : i + 1], start[i : i + 1], m[i : i + 1])
            assert_allclose(alone.chi2[0], together.chi2[i], rtol=1e-8)
            assert_allclose(alone.q[0], together.q[i], atol=1e-7)


class TestHeldRange:
    @pytest.mark.parametrize("kind", ["vector", "scalar in ambient"])
    def test_without_the_third_tangent_the_range_stays(self, kind):
        problem, y, p, m, _, rng = drawn(array_of(kind, 41, 16), 41, 4, 2)
        free = np.ones((2, 3), dtype=bool)
        free[0, 2] = False
        start = 1.05 * p + 0.05 * rng.normal(size=p.shape)
        held = refined_from(problem, y, start, m, free=free)
        loose = refined_from(problem, y, start, m)
        before = np.linalg.norm(start - problem.centroid, axis=-1)
        after = np.linalg.norm(problem.position(held.q) - problem.centroid, axis=-1)
        assert_allclose(after[:, 0], before[:, 0], rtol=1e-9)
        assert (np.abs(after[:, 1] / before[:, 1] - 1.0) > 1e-4).all()
        assert (held.chi2 > loose.chi2).all()


class TestCovariance:
    @pytest.mark.parametrize("kind", ["vector", "scalar in ambient"])
    @pytest.mark.parametrize("n_sources", [1, 2])
    def test_against_differences_of_magpylib_fields(self, kind, n_sources):
        array = array_of(kind, 52, 18)
        problem, _, p, m, *_ = drawn(array, 52, 1, n_sources)
        q = problem.homogeneous(p)
        fits = JointFits(q, problem.scaled_moment(q, m), np.zeros(1), np.zeros(1, dtype=np.int64))
        unit = np.tile(np.repeat([1.0, 300.0], 3), n_sources)

        def residual(x):
            states = (x * unit).reshape(-1, n_sources, 2, 3)
            rows = [whitened_residuals(array, np.zeros(array.n_channels), s[:, 0], s[:, 1]) for s in states]
            return np.reshape(rows, (*x.shape[:-1], -1))

        truth = np.stack([p[0], m[0]], axis=1).ravel() / unit
        jacobian = oracles.derivative(residual, truth, 0.05)
        expected = np.linalg.inv(jacobian.T @ jacobian)
        found = covariances(problem, fits)[0] / np.outer(unit, unit)
        sigma = np.sqrt(np.diagonal(expected))
        assert_allclose(found / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-4)

    def test_moduli_without_ambient_field_of_both_signs(self):
        """The opposite moment is as good, with the same covariance up to the sign of the moment."""
        array = scalar_cloud(55, ambient_T=None)
        problem, y, p, m, *_ = drawn(array, 55, 2, 1)
        assert problem.is_even
        both = refined_from(problem, y, p, m).with_opposite_moments(2)
        assert_allclose(chi2_at(problem.rows(np.array([0, 0, 1, 1])), y[[0, 0, 1, 1]], both.q, both.mu), both.chi2)
        found = covariances(problem.rows(np.array([0, 0, 1, 1])), both)
        sign = np.repeat([1.0, -1.0], 3)
        assert_allclose(found[1::2], found[::2] * np.outer(sign, sign), rtol=1e-6)

    def test_a_source_that_is_not_determined_has_none(self):
        """Three differences of two sensors do not determine six unknowns."""
        array = SensorArray(tetrahedron(1.5).sensors[:2])
        p, m = random_sources(np.random.default_rng(0), 1, 1)
        problem, _ = problem_of(array, np.zeros((1, 6)))
        q = problem.homogeneous(p)
        fits = JointFits(q, problem.scaled_moment(q, m), np.zeros(1), np.zeros(1, dtype=np.int64))
        assert np.isnan(covariances(problem, fits)).all()


@pytest.mark.usefixtures("instruction_set")
class TestCompiledTwin:
    """The compiled refinements of moduli end where the readable one does; those of vectors: test_refinement."""

    @pytest.mark.parametrize("kind", ["scalar", "scalar in ambient", "mixed in ambient"])
    @pytest.mark.parametrize("held", [False, True])
    def test_moduli(self, kind, held):
        """From 10 cm beside the truth, with a prior of the common field, and an ambient field of every row."""
        array = replace(array_of(kind, 33), common_field_T=5e-8)
        rng = np.random.default_rng(33)
        p, m = random_sources(rng, 40, 1)
        ambient = np.array(AMBIENT) + rng.normal(0.0, 1e-7, (40, 3)) if "ambient" in kind else None
        readings = np.stack(
            [
                noisy_readings(array if ambient is None else replace(array, ambient_T=tuple(ambient[i])), *of_row, rng)[
                    0
                ]
                for i, of_row in enumerate(zip(p[:, None], m[:, None], strict=True))
            ]
        )
        mask = np.ones(array.n_channels, dtype=bool)
        problem, raw = whitened_model(array, mask, readings, whitenings_of(array, mask, readings), ambient)
        y = problem.whiten(raw)
        q = problem.homogeneous(p + 0.1 * rng.normal(size=p.shape))
        mu, free = problem.scaled_moment(q, m), np.array([[True, True, not held]])
        ours, twin = refine(problem, y, q, mu, free=free), damped_gauss_newton(problem, y, q, mu, free, 400)
        both = ours.converged & twin.converged
        assert both.sum() >= 38
        assert_allclose(ours.chi2[both], twin.chi2[both], rtol=1e-9, atol=1e-7)
        assert_allclose(np.abs(np.sum(ours.q * twin.q, axis=-1))[both], 1.0, rtol=1e-9)
        # From no moment at all moduli in an ambient field have that of the linear ones first.
        if "ambient" in kind:
            from_none = refine(problem, y, q, np.zeros_like(mu), free=free)
            assert_allclose(from_none.chi2, ours.chi2, rtol=1e-9, atol=1e-7)

    def test_rows_that_differ_in_their_common_field_alone(self):
        """Errors that are marginalised row by row leave the gains of all rows the same ones."""
        array = array_of("vector", 32)
        problem, y, p, m, _, rng = drawn(array, 32, 4, 1)
        problem = problem.marginalise(rng.normal(size=(4, array.n_channels, 2)))
        y = problem.whiten(y)
        q = problem.homogeneous(p)
        mu = problem.scaled_moment(q, m)
        ours, twin = refine(problem, y, q, mu), damped_gauss_newton(problem, y, q, mu, np.ones((1, 3), dtype=bool))
        assert_allclose(ours.chi2, twin.chi2, rtol=1e-9)
