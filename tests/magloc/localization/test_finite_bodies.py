"""Magnets that are not small against their distance: magpylib's cuboids and cylinders of every aspect.

| what | oracle |
|---|---|
| readings | magpylib: exact fields of uniformly magnetised bodies |
| NEES | their true centre and moment |
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import magloc
from arrays.array import SensorArray
from arrays.geometries import grid, tetrahedron
from arrays.pose import PoseUncertainty
from magloc.fields.multipole import finite_body_errors
from magloc.localization.fit.gauss_newton import refine
from magloc.localization.model_errors import body_errors
from magloc.measurement.differences import DifferenceMeasurement
from magloc.measurement.rows import whitened_rows
from tests.oracles import fisher_information
from tests.plain_locator import plain_locator

LENGTH_M = 0.02
ASPECTS = (0.2, 0.5, 1.0, 2.0, 5.0)
UNTURNED = Rotation.from_quat([[0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Case:
    """A magnet over twelve sensors that are 0.8 lengths apart, and what they read."""

    shape: tuple[str, float]
    array: SensorArray
    readings_T: np.ndarray
    position_m: np.ndarray
    moment_Am2: np.ndarray


def magnet(kind: str, aspect: float, polarization: np.ndarray):
    """A body whose longest edge is one length, and its volume: height over width is the aspect."""
    width, height = (LENGTH_M, LENGTH_M * aspect) if aspect <= 1.0 else (LENGTH_M / aspect, LENGTH_M)
    if kind == "cuboid":
        body = magpylib.magnet.Cuboid(polarization=polarization, dimension=(width, width, height))
        return body, width * width * height
    return magpylib.magnet.Cylinder(polarization=polarization, dimension=(width, height)), np.pi / 4 * width**2 * height


def cases(lengths: float, relative_noise: float, of_each: int, seed: int = 0) -> list[Case]:
    """Magnets of every shape at some lengths above the sensors, turned at random."""
    rng = np.random.default_rng(seed)
    places = grid(4, 3, 0.8 * LENGTH_M).positions
    result = []
    for shape in [(kind, aspect) for aspect in ASPECTS for kind in ("cuboid", "cylinder")]:
        for _ in range(of_each):
            direction = Rotation.random(rng=rng).apply([0.0, 0.0, 1.0]) if rng.random() < 0.5 else np.array([0.0, 0, 1])
            body, volume = magnet(*shape, direction)
            position = LENGTH_M * np.array([*rng.uniform(-0.8, 0.8, 2), lengths])
            body.position, body.orientation = position, Rotation.random(rng=rng)
            fields = body.getB(places)
            noise_T = relative_noise * float(np.linalg.norm(fields, axis=1).max())
            readings = fields.ravel() + noise_T * rng.normal(size=fields.size)
            moment = body.orientation.apply(direction) * volume / (4e-7 * np.pi)
            result.append(Case(shape, grid(4, 3, 0.8 * LENGTH_M, noise_T=noise_T), readings, position, moment))
    return result


def nees(case: Case, body_length_m: float | None) -> tuple[float, magloc.Fixes]:
    """NEES per dimension of a fix, and the fix."""
    fixes = magloc.locate(case.array, case.readings_T, body_length_m=body_length_m)
    off = np.concatenate([fixes.position_m[0] - case.position_m, fixes.moment_Am2[0] - case.moment_Am2])
    return float(off @ np.linalg.solve(fixes.covariance[0], off)) / 6.0, fixes


class TestKnownLength:
    @pytest.mark.parametrize("of_each", [1, pytest.param(40, marks=pytest.mark.slow)])
    def test_errors_are_those_of_the_covariance(self, of_each):
        """Shapes are what they are, no random draw of the prior: 0.7 to 1.4 on average, 3 for the worst of them."""
        few = of_each < 10
        dropped = n = 0
        for lengths, relative_noise in [(d, noise) for d in (2.0, 3.0, 4.5, 6.0) for noise in (1e-3, 1e-4)]:
            of_shape: dict[tuple[str, float], list[float]] = {}
            for case in cases(lengths, relative_noise, of_each):
                value, fixes = nees(case, LENGTH_M)
                of_shape.setdefault(case.shape, []).append(value)
                dropped += bool(fixes.dropped_sensors[0])
                n += 1
            means = [np.mean(values) for values in of_shape.values()]
            # Of ten single fixes the mean is known to a fifth, and one of them may be anything.
            assert 0.7 - 0.3 * few <= np.mean(means) <= 1.4 + 0.6 * few
            assert few or max(means) <= 3.0
        assert dropped <= 1e-3 * n

    def test_double_the_length_is_consistent(self):
        for case in cases(3.0, 1e-3, 1):
            value, fixes = nees(case, 2.0 * LENGTH_M)
            assert value < 3.0
            assert not fixes.dropped_sensors[0]

    def test_half_the_length_claims_a_quarter_of_the_error_at_worst(self):
        """χ² does not see it: the shift of a dipole looks alike. The model error goes with the square of the length."""
        values = [nees(case, 0.5 * LENGTH_M)[0] for case in cases(3.0, 1e-3, 2)]
        assert np.mean(values) < 16.0 * 1.4

    def test_a_point_of_that_length_costs_accuracy_and_no_honesty(self):
        rng = np.random.default_rng(5)
        array, position, moment = grid(4, 3, 0.016, noise_T=1e-7), np.array([0.01, 0.0, 0.05]), np.array([0, 0.1, 0.2])
        exact = magloc.dipole.field(array.positions, position, moment).ravel()
        readings = exact + 1e-7 * rng.normal(size=(40, exact.size))
        point, body = (magloc.locate(array, readings, body_length_m=length) for length in (0.0, 0.02))
        trace = [np.trace(fixes.covariance[:, :3, :3], axis1=1, axis2=2) for fixes in (point, body)]
        assert (trace[1] > trace[0]).all()
        off = body.position_m - position
        assert np.einsum("ni,nij,nj->n", off, np.linalg.inv(body.covariance[:, :3, :3]), off).mean() / 3.0 < 1.2


class TestNothingSaid:
    def test_near_the_array_a_quarter_of_the_distance_is_assumed(self):
        array, moment = grid(6, 5, 0.016, noise_T=1e-7), np.array([0.0, 0.1, 0.2])
        lengths = []
        for height in (0.02, 2.0):
            exact = magloc.dipole.field(array.positions, np.array([0.0, 0.0, height]), moment * (height / 0.02) ** 3)
            fixes = magloc.locate(array, exact.ravel())
            lengths.append(fixes.body_length_m[0])
        nearest = np.linalg.norm(array.positions - [0.0, 0.0, 0.02], axis=1).min()
        assert lengths[0] == pytest.approx(0.25 * nearest, rel=0.02)
        assert lengths[1] == 0.0

    def test_said_to_be_a_point(self):
        case = cases(2.0, 1e-3, 1)[0]
        assert magloc.locate(case.array, case.readings_T, body_length_m=0.0).body_length_m[0] == 0.0


class TestRounds:
    """Errors of bodies are linearised where the fit is with them: after three rounds of that it stays there."""

    ARRAY = grid(6, 5, 0.016, noise_T=1e-6)

    @classmethod
    def bars(cls):
        """What thirty sensors read of forty bars 2 to 6 lengths above them, turned at random."""
        rng = np.random.default_rng(6)
        readings = []
        for lengths in rng.uniform(2.0, 6.0, 40):
            long = rng.uniform(0.003, 0.006)
            bar = magpylib.magnet.Cuboid(polarization=(0.1, 0.2, 0.3), dimension=(long / 3.0, long / 3.0, long))
            bar.position, bar.orientation = [*rng.uniform(-0.03, 0.03, 2), lengths * long], Rotation.random(rng=rng)
            fields = bar.getB(cls.ARRAY.positions).ravel()
            readings.append(fields * 1e-4 / np.abs(fields).max() + 1e-6 * rng.normal(size=fields.size))
        return np.array(readings)

    def test_another_round_would_not_move_a_fix(self):
        """By a thousandth of its standard deviation."""
        bars = self.bars()
        fixes = plain_locator(self.ARRAY).fit_rows(bars)
        assert (fixes.body_length_m > 0.0).sum() > 30
        (rows,) = whitened_rows(self.ARRAY, bars, None, len(bars))
        q = rows.model.homogeneous(fixes.position_m)[:, None]
        mu = rows.model.scaled_moment(q, fixes.moment_Am2[:, None])
        noisy = rows.marginalise(body_errors(rows.model, q, mu, fixes.body_length_m[:, None]))
        moved = noisy.model.position(refine(noisy.model, noisy.y, q, mu).q)[:, 0] - fixes.position_m
        squares = np.einsum("ni,nij,nj->n", moved, np.linalg.inv(fixes.covariance[:, :3, :3]), moved)
        assert np.sqrt(squares.max()) < 1e-3


class TestFarFromTheArray:
    """Nothing said, and too far for a default length: χ² does not see a body, so what one would do is told."""

    def test_errors_of_bodies_of_a_quarter_of_the_distance_are_as_told(self):
        """400 fixes of draws of such bodies: NEES over the square of the factor is known to a tenth, 4.5 σ here."""
        rng, place, moment = np.random.default_rng(3), np.array([0.3, 0.2, -5.0]), np.array([50.0, 60.0, -60.0])
        array = tetrahedron(1.5, noise_T=1e-10)
        separation = array.positions - place
        nearest = np.linalg.norm(separation, axis=1).min()
        errors = finite_body_errors(separation, moment, 0.25 * nearest).reshape(12, 14)
        exact = magloc.dipole.field(array.positions, place, moment).ravel()
        readings = exact + rng.normal(size=(400, 14)) @ errors.T + 1e-10 * rng.normal(size=(400, 12))
        fixes = magloc.locate(array, readings, prior=magloc.SourcePrior(high_m=(np.inf, np.inf, 0.0)))
        off = np.hstack([fixes.position_m - place, fixes.moment_Am2 - moment])
        squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(fixes.covariance), off) / 6.0
        assert np.median(fixes.body_factor) > 3.0
        assert np.mean(squares / fixes.body_factor**2) == pytest.approx(1.0, abs=0.45)

    @pytest.mark.parametrize("relative_noise", [1e-2, 1e-3, 1e-4])
    @pytest.mark.parametrize("lengths", [2.0, *(pytest.param(n, marks=pytest.mark.slow) for n in (3.0, 4.0)), 6.0])
    def test_no_body_errs_in_silence(self, lengths, relative_noise):
        """magpylib's, at four lengths as told: NEES is below three squares, else it goes as length to the fourth."""
        for case in cases(lengths, relative_noise, 1, seed=1):
            value, fixes = nees(case, None)
            assert fixes.body_length_m[0] == 0.0
            assert value < 3.0 * fixes.body_factor[0] ** 2 * max(1.0, (4.0 / lengths) ** 4)
            assert value < 10.0 or "for a body" in fixes.caution

    def test_what_is_said_of_the_length_ends_it(self):
        case = cases(3.0, 1e-3, 1)[0]
        for length in (0.0, LENGTH_M):
            _, fixes = nees(case, length)
            assert fixes.body_factor.tolist() == [1.0]
            assert fixes[0].body_factor == 1.0
            assert not fixes.caution

    def test_a_pose_that_errs_more_hides_it(self):
        case = cases(3.0, 1e-3, 1)[0]
        readings = magloc.Readings(case.readings_T[None], array_position_m=np.zeros((1, 3)), array_rotation=UNTURNED)
        factors = [
            magloc.locate(replace(case.array, pose=pose), readings)[0].body_factor
            for pose in (None, PoseUncertainty(1e-3, 0.1), PoseUncertainty(0.1, 0.3, 0.0, 0.1, 0.3))
        ]
        assert factors[0] > factors[1] > factors[2]
        assert factors[2] < 0.2 * factors[0]  # a pose does not change the modulus of the moment

    def test_of_moments_at_a_known_place(self):
        """The covariance is of three numbers, and the body errs in those alone."""
        case = cases(3.0, 1e-4, 1)[0]
        fixes = magloc.locate(case.array, case.readings_T, position_m=case.position_m)
        off = fixes.moment_Am2[0] - case.moment_Am2
        assert fixes.body_covariance.shape == (1, 3, 3)
        assert fixes.body_factor[0] > 2.0
        assert off @ np.linalg.solve(fixes.covariance[0], off) / 3.0 < 10.0 * fixes.body_factor[0] ** 2


class TestMisfit:
    def test_sigma_knows_of_chi2(self):
        """A row that no model explains: χ² per degree of freedom is a guess of the variance, noise alone is none."""
        case = cases(2.0, 1e-4, 1)[0]
        fixes = magloc.locate(case.array, case.readings_T, body_length_m=0.0, exclude_faulty=False)
        assert fixes.misfit[0]
        measurement = DifferenceMeasurement.of(case.array)
        noise_alone = np.linalg.inv(fisher_information(measurement, fixes.position_m[0], fixes.moment_Am2[0]))
        expected = noise_alone * fixes.chi2[0] / fixes.dof[0]
        unit = np.sqrt(np.diagonal(expected))
        np.testing.assert_allclose(
            fixes.covariance[0] / unit / unit[:, None], expected / unit / unit[:, None], atol=1e-5
        )
