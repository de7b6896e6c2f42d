"""The compiled filter: of one source against SciPy's optimum, of several against the chart's formulas."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from decimal import Decimal, localcontext
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from arrays import geometries
from arrays.array import SensorArray
from arrays.pose import PoseUncertainty
from magloc import core
from magloc.measurement.differences import predicted_channels
from magloc.tracking import row_filter
from magloc.tracking.chart.mixture import component_moments
from magloc.tracking.coordinates import Chart
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.motion import CoordinatedTurn, KnownMotion, MotionModel, OrnsteinUhlenbeck, RandomWalk
from magloc.tracking.row_filter import LEAST_SHARE, Gaussians
from magloc.tracking.rows import Row, Rows
from magloc.tracking.tracker import Tracker
from tests.passing_source import MOMENT, NOISE_T, POSITION

FloatArray = NDArray[np.float64]
all_instruction_sets = pytest.mark.usefixtures("instruction_set")
SOURCE = np.concatenate([POSITION, MOMENT])
MOTIONS: list[MotionModel] = [
    RandomWalk(0.1, 0.02),
    OrnsteinUhlenbeck(0.1, 0.02),
    CoordinatedTurn(0.1, 0.1),
    KnownMotion(0.1, 0.01, array_rate_rad_s=(0.0, 0.02, 0.1)),
]
ARRAYS = [
    geometries.tetrahedron(1.5, "vector", NOISE_T),
    replace(
        geometries.cube(1.5, "scalar", NOISE_T),
        ambient_T=(1e-5, -2e-5, 4.5e-5),
        ambient_uncertainty_T=5e-8,
        ambient_uncertainty_white_T=1e-8,
    ),
]
NEW_IN_EVERY_ROW = PoseUncertainty(0.02, 0.01, 0.0, 0.0, 0.0, 0.0)
WALKING = replace(NEW_IN_EVERY_ROW, correlation_s=10.0, position_constant_m=0.05, attitude_constant_rad=0.01)


@dataclass(frozen=True)
class Case:
    """A row, and predictions of the source that it shows."""

    row: RowMeasurement
    x: FloatArray
    S: FloatArray

    @property
    def gaussians(self) -> Gaussians:
        return Gaussians(self.x, self.S, n_nuisances=self.row.n_pose + self.row.effect.shape[1])


def case(
    array: SensorArray,
    motion: MotionModel,
    seed: int,
    offset_T: float = 0.0,
    missing: int = 0,
    pose: PoseUncertainty | None = None,
) -> Case:
    """A row of an array somewhere, of which some channels are missing, and three broad predictions."""
    rng = np.random.default_rng(seed)
    origin, R = rng.normal(size=3), Rotation.random(rng=rng)
    readings = predicted_channels(array, POSITION, MOMENT) + array.channel_noise_T * rng.normal(size=array.n_channels)
    readings[rng.choice(array.n_channels, missing, replace=False)] = np.nan
    sensors = tuple(replace(one, offset_uncertainty_T=offset_T) for one in array.sensors)
    measurements = Tracker(replace(array, sensors=sensors, pose=pose), motion).measurements
    row = measurements.of(Row(0.5, readings, origin, R.as_matrix()))
    n, p, e = motion.n_states, row.n_pose, row.effect.shape[1]
    x = np.zeros((3, n + p + e))
    of_array = SOURCE * (1.0 + 0.05 * rng.normal(size=(3, 6)))
    x[:, :3], x[:, 3:6] = R.apply(of_array[:, :3]) + origin, R.apply(of_array[:, 3:])
    x[:, 6:n], x[:, n : n + p] = 0.05 * rng.normal(size=(3, n - 6)), 0.3 * rng.normal(size=(3, p))
    unit = float(np.linalg.norm(MOMENT) / np.linalg.norm(POSITION) ** 4)
    sigma = np.repeat([0.05, 0.05 * unit, 0.03, 0.5], [3, 3, n - 6, p])
    S = np.zeros((3, n + p + e, n + p + e))
    S[:, : n + p] = sigma[:, None] * rng.normal(size=(3, n + p, n + p + e)) / 2.0
    S[:, np.arange(n + p, n + p + e), np.arange(n + p, n + p + e)] = measurements.errors.sigma
    return Case(row, x, S)


def covariance(S: FloatArray) -> FloatArray:
    return np.asarray(S @ np.swapaxes(S, -1, -2))


def assert_same_covariances(found: FloatArray, expected: FloatArray, atol: float) -> None:
    """Of roots (..., N, N): along every direction, in units of what is known of it."""
    for of_found, of_expected in zip(found, expected, strict=True):
        ratio = np.linalg.solve(of_expected, of_found)
        np.testing.assert_allclose(ratio @ ratio.T, np.eye(len(ratio)), atol=atol)


def _decimals(matrix: FloatArray) -> NDArray[np.object_]:
    return np.vectorize(Decimal, otypes=[object])(matrix)


def _solve(matrix: NDArray[np.object_], right: NDArray[np.object_]) -> NDArray[np.object_]:
    """Gauss and Jordan's elimination with pivots."""
    n, rows = len(matrix), np.concatenate([matrix, right], axis=1)
    for i in range(n):
        pivot = i + int(np.argmax(np.abs(rows[i:, i])))
        rows[[i, pivot]] = rows[[pivot, i]]
        rows[i] = rows[i] / rows[i, i]
        for j in range(n):
            if j != i:
                rows[j] = rows[j] - rows[j, i] * rows[i]
    return rows[:, n:]


@dataclass(frozen=True)
class Fit:
    """SciPy's optimum of a row and one of its predictions; derivatives by differences."""

    chi2: float
    nis: float
    log_evidence: float
    innovation2: float
    x: FloatArray
    P: FloatArray


def minimise(at: Case, i: int, bends: bool, shares: FloatArray) -> Fit:
    """Fit of one prediction: standard numbers ζ of what is seen, of errors of sensors, and of what else moves, in turn.

    With bends, s = ζ + M (h(ζ) - h(0) - J ζ) of what is seen is normal in place of ζ, where errors of the pose have
    shares, and of errors of sensors ζ + M' (h(ζ) - h(0) - J s).
    """
    row, n, m, x = at.row, at.row.n_charted, at.row.n_motion, at.x[i]
    seen, errors = np.r_[:6, m:n], np.arange(n, len(x))
    order = np.r_[seen, errors, 6:m]
    s, d = len(seen), len(seen) + len(errors)
    U = np.zeros_like(at.S[i])
    U[order] = np.linalg.qr(at.S[i][order].T, mode="r").T
    chart = row.chart(x[None, :n]).with_firm_moments(at.S[i : i + 1, :n])
    lasting = replace(row, pose_effect=row.pose_effect * shares)

    def h(zeta: FloatArray, of_row: RowMeasurement = lasting) -> FloatArray:
        return of_row.predict_source(chart.retract((U @ zeta)[None, :n])[0])

    nowhere = np.zeros(len(x))
    J, of_errors = (
        lasting.directional_derivative(*chart.linearise(np.zeros((1, n))))[0] @ U[:n, :s],
        row.effect @ U[errors],
    )
    whiten = np.linalg.cholesky(np.linalg.inv(np.eye(len(row.z)) + of_errors[:, s:d] @ of_errors[:, s:d].T)).T
    Q, R = np.linalg.qr(np.concatenate([whiten @ J, LEAST_SHARE * np.eye(s)]))
    M = bends * np.linalg.solve(R, Q[: len(whiten)].T @ whiten)

    Q, R = np.linalg.qr(np.concatenate([of_errors[:, s:d], LEAST_SHARE * np.eye(d - s)]))
    M_errors = bends * np.linalg.solve(R, Q[: len(J)].T)

    at_prediction = h(nowhere)

    def normal(zeta: FloatArray) -> FloatArray:
        change = h(zeta) - at_prediction
        seen = zeta[:s] + M @ (change - J @ zeta[:s])
        return np.concatenate([seen, zeta[s:d] + M_errors @ (change - J @ seen), zeta[d:]])

    def bent(zeta: FloatArray) -> FloatArray:
        return np.concatenate([normal(zeta)[:s], zeta[s:]])

    def misfit(zeta: FloatArray) -> FloatArray:
        standard = normal(zeta)
        of_noise = of_errors @ np.concatenate([standard[:s], zeta[s:]])
        return np.concatenate([row.z - h(zeta, row) - row.effect @ x[errors] - of_noise, -standard])

    zeta = least_squares(misfit, nowhere, lambda zeta: slope(misfit, zeta), xtol=1e-12, ftol=1e-15, gtol=1e-12).x
    found, H, D = misfit(zeta), -slope(misfit, zeta), slope(normal, zeta)
    k = len(row.z)
    log_evidence = np.linalg.slogdet(D)[1] - 0.5 * (found @ found + np.linalg.slogdet(H.T @ H)[1])
    G = H[:k] @ np.linalg.inv(D)
    innovation = found[:k] + G @ normal(zeta)
    e, along = U @ zeta, U.copy()
    e[errors], along[errors] = U[errors] @ bent(zeta), U[errors] @ slope(bent, zeta)
    after = x + e
    after[:n] = chart.retract(e[None, :n])[0]
    along[:n] = (row.chart(after[None, :n]).inverse_jacobian() @ chart.jacobian(e[None, :n]))[0] @ along[:n]
    P = along @ np.linalg.solve(H.T @ H, along.T)
    innovation2 = float(innovation @ np.linalg.solve(np.eye(k) + G @ G.T, innovation))
    return Fit(float(found[:k] @ found[:k]), float(found @ found), float(log_evidence), innovation2, after, P)


@cache
def passing_case(array: SensorArray, seed: int, offset_T: float, pose: PoseUncertainty | None) -> Case:
    return case(array, MOTIONS[seed], seed, offset_T, seed % 3, pose)


def lasting_shares(at: Case) -> FloatArray:
    return np.linspace(0.0, 1.0, at.row.n_pose)


@cache
def optimum(array: SensorArray, seed: int, offset_T: float, pose: PoseUncertainty | None, i: int, bends: bool) -> Fit:
    """SciPy's optimum, the same for all instruction sets."""
    at = passing_case(array, seed, offset_T, pose)
    return minimise(at, i, bends, lasting_shares(at))


class TestOneSource:
    @all_instruction_sets
    @pytest.mark.parametrize(
        ("kind", "pose", "offset_T", "bends", "seed"),
        [
            # In `make test` each two of these come together at least once.
            pytest.param(
                *(kind, pose, offset_T, bends, seed),
                marks=[pytest.mark.slow] if (i + bends + seed) % 2 or (i // 2 + kind + seed // 2) % 2 else [],
            )
            for kind in range(len(ARRAYS))
            for i, (pose, offset_T) in enumerate([(None, 0.0), (None, 4e-9), (NEW_IN_EVERY_ROW, 0.0), (WALKING, 4e-9)])
            for bends in (False, True)
            for seed in range(4)
        ],
    )
    def test_update_is_the_best_fit(
        self, kind: int, seed: int, bends: bool, pose: PoseUncertainty | None, offset_T: float
    ) -> None:
        """Both end within 1e-3 σ of the optimum, where the cost is flat: 1e-6 of it, and 1e-3 of first derivatives."""
        array = ARRAYS[kind]
        at = passing_case(array, seed, offset_T, pose)
        shares = lasting_shares(at)
        found = row_filter.update(
            at.gaussians, at.row.kernel_rows, bends=np.full(3, bends), pose_lasts=shares, innovation=True
        )
        assert found.innovation is not None
        assert found.converged.any()
        i = int(np.argmax(found.converged))
        expected = optimum(array, seed, offset_T, pose, i, bends)
        assert found.nis[i] == pytest.approx(expected.nis, rel=1e-6, abs=5e-6)
        assert np.sum(found.innovation[i] ** 2) == pytest.approx(expected.innovation2, rel=1e-5, abs=1e-5)
        assert found.chi2[i] == pytest.approx(expected.chi2, rel=2e-3, abs=2e-3)
        assert found.log_evidence[i] == pytest.approx(expected.log_evidence, abs=3e-3)
        sigma = np.sqrt(np.diagonal(expected.P))
        assert np.abs((found.x[i] - expected.x)[6:] / sigma[6:]).max(initial=0.0) < 5e-3
        unit = np.outer(sigma, sigma)
        np.testing.assert_allclose(covariance(found.S[i]) / unit, expected.P / unit, atol=5e-3)

    @all_instruction_sets
    @given(motion=st.sampled_from(MOTIONS), seed=st.integers(0, 2**32), offset_T=st.sampled_from([0.0, 4e-9, 2e-5]))
    @settings(max_examples=25)
    def test_prediction(self, motion: MotionModel, seed: int, offset_T: float) -> None:
        """A transition and its noise in the charts before and after."""
        at = case(ARRAYS[0], motion, seed, offset_T)
        n, e = motion.n_states, at.row.effect.shape[1]
        centroid = at.row.centroid_m + np.array([0.3, -0.2, 0.1])
        kept, added = np.full(e, 0.99), np.where(np.arange(e) % 2, 1e-9, 0.0)
        steps = row_filter.steps_problem(
            motion, [0.5], np.zeros(1, dtype=np.intp), (kept[None], added[None]), at.x[:, :n]
        )
        found = row_filter.predict(at.gaussians, centroid, steps, at.row.kernel_rows)
        for x, S, x_found, S_found in zip(at.x, at.S, found.x, found.S, strict=True):
            moved, F, S_q = motion.step(x[:n], 0.5)
            expected = np.append(moved, kept * x[n:])
            # A turn rounds each component by a share of the whole: 4e-13 of it in one of 75 random examples.
            np.testing.assert_allclose(x_found, expected, rtol=1e-12, atol=1e-12 * np.linalg.norm(moved))
            inverse = at.row.chart(moved[None]).inverse_jacobian()[0]
            A = inverse @ F @ Chart.at(x[None, :n], centroid, at.row.radius_m).jacobian(np.zeros((1, n)))[0]
            spread = block_diag(A, np.diag(kept)) @ S
            root = np.linalg.qr(np.concatenate([spread, block_diag(inverse @ S_q, np.diag(added))], axis=1).T, "r").T
            assert_same_covariances(S_found[None], root[None], 1e-6)

    @all_instruction_sets
    @pytest.mark.parametrize("offset_T", [0.0, 2e-5])
    def test_covariance_keeps_what_is_known_a_million_times_better(self, offset_T: float) -> None:
        """Offsets of 20 µT beside 0.2 nT of noise, by the same formula with fifty digits."""
        at = case(ARRAYS[0], RandomWalk(0.1, 0.02), 3, offset_T)
        found = row_filter.update(at.gaussians, at.row.kernel_rows).after
        n = at.row.n_charted
        for before, x, S_before, S in zip(at.x, found.x, at.S, found.S, strict=True):
            chart = at.row.chart(before[None, :n]).with_firm_moments(S_before[None])
            after = at.row.chart(x[None, :n])
            fit = least_squares(
                lambda e, chart=chart, x=x: chart.retract(e[None])[0] - x[:n], np.zeros(n), xtol=1e-15, x_scale=0.1
            )
            e = fit.x
            H = at.row.directional_derivative(*chart.linearise(e[None]))[0]
            J = np.concatenate([H, at.row.effect], axis=1) @ S_before
            turn = np.eye(len(x))
            turn[:n, :n] = (after.inverse_jacobian() @ chart.jacobian(e[None]))[0]
            with localcontext() as context:
                context.prec = 50
                left = _solve(_decimals(turn @ S_before), _decimals(S))
                of_zeta = _decimals(np.eye(len(x))) + _decimals(J.T) @ _decimals(J)
                square = (left.T @ of_zeta @ left).astype(float)
            np.testing.assert_allclose(square, np.eye(len(x)), atol=1e-5)

    def test_a_source_on_a_sensor_does_not_converge(self) -> None:
        at = case(ARRAYS[0], RandomWalk(0.1, 0.02), 0)
        at.x[:, :3] = at.row.row.origin_m + at.row.row.R_world_from_array @ ARRAYS[0].positions[1]
        assert not row_filter.update(at.gaussians, at.row.kernel_rows).converged.any()


def retract(
    x: FloatArray, e: FloatArray, centroid: FloatArray, radius: float, q: int, *, firm: bool = True
) -> FloatArray:
    """One source's state (n,) at coordinates (n,) about x, by the chart's formulas, its moment being firm or not."""
    d = x[:3] - centroid
    r = float(np.linalg.norm(d))
    u, length = d / r, max(r, radius)
    E = Chart.at(x[None], centroid, radius).E[0]
    w = u + E @ e[1:3]
    there = x + e
    growth = math.exp(e[0])
    there[:3] = x[:3] + length * (growth * w / np.linalg.norm(w) - u)
    size = float(np.linalg.norm(x[3:6]))
    m = x[3:6] / size
    n = length**q * e[3:6] / size
    b = m + n - (m @ n) * m
    there[3:6] = growth**q * size * (math.exp(m @ n) * b / np.linalg.norm(b) if firm else m + n)
    there[6:9] = growth * (x[6:9] + length * e[6:9])
    return there


class Board:
    """Magnets above sixteen sensors, which read them in a common field of 100 µT that nobody knows."""

    array = geometries.grid(4, 4, 0.026, "vector", 5e-7)
    magnets = np.array(
        [
            [-0.03, -0.02, 0.05, 0.02, 0.03, 0.05],
            [0.03, 0.02, 0.06, 0.05, -0.02, 0.01],
            [0.0, 0.04, 0.07, -0.02, 0.02, 0.07],
        ]
    )

    def __init__(self, n_sources: int, seed: int, n_states: int = 12) -> None:
        self.K, self.n = n_sources, n_states
        rng = np.random.default_rng(seed)
        noise, N = self.array.channel_noise_T, n_sources * n_states + 3
        self.origin, R = rng.normal(size=3), Rotation.random(rng=rng)
        self.centroid, self.radius = self.origin + R.as_matrix() @ self.array.centroid, self.array.circumradius
        sources = self.magnets[:n_sources] * (1.0 + 0.02 * rng.normal(size=(2, n_sources, 6)))
        truth, common = self.magnets[:n_sources], 1e-4 * rng.normal(size=3)
        fields = sum(predicted_channels(self.array, one[:3], one[3:]) for one in truth)
        gain = self.array.channel_gain / noise[:, None]
        self.exact = fields / noise + gain @ common
        z = self.exact + rng.normal(size=len(noise))
        self.rows = Rows(
            self.array,
            z[None],
            np.array([len(z)]),
            np.diag(1.0 / noise)[None],
            np.zeros(1, dtype=np.intp),
            gain[None],
            self.origin[None],
            R.as_matrix()[None],
            np.zeros((1, self.array.n_sensors, 3)),
        )
        self.R, self.z, self.effect, self.noise = R, z, gain, noise
        x = np.zeros((2, N))
        of_sources = x[:, :-3].reshape(2, n_sources, n_states)
        of_sources[..., :3] = R.apply(sources[..., :3].reshape(-1, 3)).reshape(2, -1, 3) + self.origin
        of_sources[..., 3:6] = R.apply(sources[..., 3:].reshape(-1, 3)).reshape(2, -1, 3)
        of_sources[..., 6:] = 0.1 * rng.normal(size=(2, n_sources, n_states - 6))
        unit = 0.06
        sigma = np.tile(np.repeat([0.03, 0.03 * unit, 0.3], [3, 3, n_states - 6]), n_sources)
        S = np.concatenate([sigma, np.full(3, 1e-4)])[:, None] * rng.normal(size=(2, N, N)) / math.sqrt(N)
        self.gaussians = Gaussians(x, S, n_sources, 3, power=0)

    def repeat(self, readings: FloatArray) -> Rows:
        """Rows (n) of readings (n, k) where the array stands."""
        same = ("counts", "effects", "origins_m", "rotations", "transform_of_row")
        many = {name: np.repeat(getattr(self.rows, name), len(readings), axis=0) for name in same}
        return replace(self.rows, readings=readings, **many)

    def retract(self, x: FloatArray, e: FloatArray, *, firm: bool = True) -> FloatArray:
        """A whole state at coordinates."""
        there = x + e
        for k in range(self.K):
            of_source = slice(self.n * k, self.n * (k + 1))
            there[of_source] = retract(x[of_source], e[of_source], self.centroid, self.radius, 0, firm=firm)
        return there

    def coordinates(self, x: FloatArray, there: FloatArray) -> FloatArray:
        """The inverse of it near by, for moments that are not firm: Newton's steps."""
        e = np.zeros(len(x))
        for _ in range(6):
            by_e = slope(lambda e: self.retract(x, e, firm=False), e)
            e += np.linalg.solve(by_e, there - self.retract(x, e, firm=False))
        return e

    def h(self, x: FloatArray) -> FloatArray:
        """Predicted readings in units of their noise."""
        values = self.effect @ x[-3:]
        for k in range(self.K):
            source = x[self.n * k :]
            p, m = self.R.inv().apply(source[:3] - self.origin), self.R.inv().apply(source[3:6])
            values += predicted_channels(self.array, p, m) / self.noise
        return values


def slope(function: Callable[[FloatArray], FloatArray], at: FloatArray) -> FloatArray:
    """Jacobian by central differences."""
    steps = 1e-5 * np.eye(len(at))
    return np.stack([(function(at + d) - function(at - d)) / 2e-5 for d in steps], axis=1)


@cache
def board_optima(n_sources: int) -> tuple[Board, list[OptimizeResult]]:
    """SciPy's optimum of each prediction, the same for all instruction sets; ``jac`` by central differences."""
    board, fits = Board(n_sources, n_sources), []
    for x, S in zip(board.gaussians.x, board.gaussians.S, strict=True):

        def misfit(zeta: FloatArray, x: FloatArray = x, S: FloatArray = S) -> FloatArray:
            return np.concatenate([board.z - board.h(board.retract(x, S @ zeta)), -zeta])

        fit = least_squares(misfit, np.zeros(len(x)), jac="3-point", xtol=1e-12, ftol=1e-14, gtol=1e-12)
        fits.append(OptimizeResult(fit, jac=slope(misfit, fit.x)))
    return board, fits


@dataclass(frozen=True)
class SmoothedRows:
    """Rows of a board to smooth, and the Gaussians of all states and readings together, one of each track."""

    board: Board
    tracks: FloatArray
    prior: Gaussians
    steps: core.Problem
    rows: Rows
    gaussians: list[tuple[FloatArray, ...]]
    """Mean (m N,) and covariance (m N, m N) given the readings, and what is left of these (m k,) and its covariance."""


@cache
def smoothed_rows(n_sources: int) -> SmoothedRows:
    board, motion, m, dt_s = Board(n_sources, 40 + n_sources), OrnsteinUhlenbeck(0.3, 1.8, 1.5), 4, 0.05
    rng, n, k = np.random.default_rng(n_sources), n_sources * board.n, len(board.z)
    N = n + 3
    tracks = board.gaussians.x[:, None, :n] * (1.0 + 0.01 * rng.normal(size=(2, m, n)))
    readings = board.exact + rng.normal(size=(m, k))
    S = board.gaussians.S
    prior = replace(board.gaussians, x=0.3 * np.linalg.norm(S, axis=2) * rng.normal(size=(2, N)))
    kept, added = np.full((1, 3), 0.9), np.full((1, 3), 1e-6)
    steps = row_filter.steps_problem(motion, [dt_s], np.zeros(m, dtype=np.intp), (kept, added))
    gaussians = []
    for c, track in enumerate(np.pad(tracks, ((0, 0), (0, 0), (0, 3)))):
        # B (e_0, e_1, ...) = (e_0, shift_1 + noise_1, ...)
        B, H = np.eye(m * N), np.zeros((m * k, m * N))
        shift, D = np.zeros(m * N), np.zeros((m * N, m * N))
        shift[:N], D[:N, :N] = prior.x[c], S[c] @ S[c].T
        z = readings.ravel() - np.concatenate([board.h(x) for x in track])
        L = [slope(lambda e, x=x: board.retract(x, e), np.zeros(N)) for x in track]
        for row, x in enumerate(track):
            at = slice(N * row, N * (row + 1))
            H[k * row : k * (row + 1), at] = slope(lambda e, x=x: board.h(board.retract(x, e)), np.zeros(N))
            if not row:
                continue
            F, Q, moved = np.diag(np.r_[np.zeros(n), kept[0]]), np.diag(np.r_[np.zeros(n), added[0] ** 2]), x.copy()
            for source in (slice(i, i + 12) for i in range(0, n, 12)):
                moved[source], F[source, source], S_q = motion.step(track[row - 1, source], dt_s)
                Q[source, source] = S_q @ S_q.T
            B[at, N * (row - 1) : N * row] = -np.linalg.solve(L[row], F @ L[row - 1])
            D[at, at] = np.linalg.solve(L[row], np.linalg.solve(L[row], Q).T)
            shift[at] = board.coordinates(x, moved)
        mean, C = np.linalg.solve(B, shift), np.linalg.solve(B, np.linalg.solve(B, D).T)
        left, covariance_z = z - H @ mean, np.eye(m * k) + H @ C @ H.T
        gain = np.linalg.solve(covariance_z, H @ C).T
        gaussians.append((mean + gain @ left, C - gain @ H @ C, left, covariance_z))
    return SmoothedRows(board, tracks, prior, steps, board.repeat(readings), gaussians)


@all_instruction_sets
@pytest.mark.parametrize("n_sources", [1, 2, 3])
class TestSeveralSources:
    """Against the formulas of the chart, minimised by SciPy, with derivatives by differences."""

    def test_update(self, n_sources: int) -> None:
        board, fits = board_optima(n_sources)
        found = row_filter.update(board.gaussians, board.rows, linearisations=True, innovation=True)
        assert found.converged.all()
        assert found.standardised is not None
        sensor_chi2 = np.vecdot(found.standardised, found.standardised)
        assert found.innovation is not None
        for c, (x, S, fit) in enumerate(zip(board.gaussians.x, board.gaussians.S, fits, strict=True)):
            J, k, there = -fit.jac, len(board.z), board.retract(x, S @ fit.x)
            assert found.nis[c] == pytest.approx(2.0 * fit.cost, abs=1e-5)
            assert found.chi2[c] == pytest.approx(float(np.sum(fit.fun[:k] ** 2)), abs=1e-2)
            log_N = float(np.linalg.slogdet(J.T @ J)[1])
            assert found.log_evidence[c] == pytest.approx(-fit.cost - 0.5 * log_N, abs=1e-2)
            # Coordinates about the mode, of small changes of the coordinates about the prediction.
            turn = np.linalg.solve(
                slope(lambda e, there=there: board.retract(there, e), np.zeros(len(x))),
                slope(lambda e, x=x: board.retract(x, e), S @ fit.x),
            )
            root = turn @ S @ np.linalg.inv(np.linalg.qr(J, mode="r"))
            assert_same_covariances(found.after.S[c : c + 1], root[None], 1e-2)
            off = np.linalg.solve(
                slope(lambda e, there=there: board.retract(there, e), np.zeros(len(x))) @ root,
                found.after.x[c] - there,
            )
            assert np.linalg.norm(off) < 2e-3
            # What three free readings of a sensor explain, all else being fitted again.
            for s in range(board.array.n_sensors):
                free = np.zeros((len(fit.fun), 3))
                free[np.flatnonzero(board.array.channel_sensor == s), np.arange(3)] = 1.0
                wide = np.concatenate([J, free], axis=1)
                left = np.linalg.lstsq(wide, fit.fun)[0]
                explained = 2.0 * fit.cost - float(np.sum((fit.fun - wide @ left) ** 2))
                assert sensor_chi2[c, s] == pytest.approx(explained, rel=0.02, abs=0.02)
            innovation = fit.fun[:k] - J[:k] @ fit.fun[k:]
            whitened = np.linalg.solve(np.linalg.cholesky(np.eye(k) + J[:k] @ J[:k].T), innovation)
            np.testing.assert_allclose(found.innovation[c], whitened, atol=1e-2)
            gain = float(np.trace(np.linalg.solve(J.T @ J, J[:k].T @ J[:k])))
            assert found.correction is not None
            assert found.correction[c] == pytest.approx(float(fit.x @ fit.x) - gain, abs=1e-2)

    def test_prediction(self, n_sources: int) -> None:
        board, motion = Board(n_sources, 10 + n_sources), OrnsteinUhlenbeck(0.3, 1.8, 1.5)
        before, centroid = board.gaussians, board.centroid + np.array([0.01, -0.02, 0.03])
        steps = row_filter.steps_problem(
            motion, [0.02], np.zeros(1, dtype=np.intp), (np.full((1, 3), 0.9), np.full((1, 3), 1e-6))
        )
        found = row_filter.predict(before, centroid, steps, board.rows)
        for x, S, x_found, S_found in zip(before.x, before.S, found.x, found.S, strict=True):
            expected, F, Q = x.copy(), np.eye(len(x)), np.zeros((len(x), len(x)))
            L, L_after = np.eye(len(x)), np.eye(len(x))
            F[-3:, -3:], Q[-3:, -3:], expected[-3:] = 0.9 * np.eye(3), 1e-12 * np.eye(3), 0.9 * x[-3:]
            for k in range(n_sources):
                at = slice(12 * k, 12 * (k + 1))
                expected[at], F[at, at], S_q = motion.step(x[at], 0.02)
                Q[at, at] = S_q @ S_q.T
                for of_chart, state, origin in ((L, x, centroid), (L_after, expected, board.centroid)):
                    of_chart[at, at] = slope(
                        lambda e, x=state[at], c=origin: retract(x, e, c, board.radius, 0), np.zeros(12)
                    )
            np.testing.assert_allclose(x_found, expected, rtol=1e-12)
            moved = np.linalg.solve(L_after, F @ L @ S)
            P = moved @ moved.T + np.linalg.solve(L_after, np.linalg.solve(L_after, Q).T)
            scale = np.sqrt(np.diagonal(P))
            np.testing.assert_allclose(
                covariance(S_found) / np.outer(scale, scale), P / np.outer(scale, scale), atol=1e-7
            )

    def test_bends(self, n_sources: int) -> None:
        board = Board(n_sources, 20 + n_sources)
        bends, directions = row_filter.bends(board.gaussians, board.rows, 3.0)
        first = [12 * k + i for k in range(n_sources) for i in range(6)]
        order = np.array(first + [i for i in range(12 * n_sources + 3) if i not in first])
        for c, (x, S) in enumerate(zip(board.gaussians.x, board.gaussians.S, strict=True)):
            # Standard numbers of the sources first.
            root = np.zeros_like(S)
            root[order] = np.linalg.qr(S[order].T, mode="r").T
            J = slope(lambda e, x=x: board.h(board.retract(x, e)), np.zeros(len(x))) @ root[:, : 6 * n_sources]
            axes = np.linalg.svd(J)[2]
            standard = np.linalg.solve(root, directions[c].T).T
            told = np.linalg.norm(J @ standard[:, : 6 * n_sources].T, axis=0)
            for one, axis in zip(np.argsort(-told), axes, strict=True):
                found, v = standard[one], directions[c, one]
                assert float(np.linalg.norm(found)) == pytest.approx(1.0, abs=1e-9)
                assert abs(float(found[: 6 * n_sources] @ axis)) == pytest.approx(1.0, abs=1e-6)
                ahead, behind = board.h(board.retract(x, v)), board.h(board.retract(x, -v))
                bend, gradient = 0.5 * (ahead + behind) - board.h(x), 0.5 * (ahead - behind)
                g2 = float(gradient @ gradient)
                share = math.sqrt(min(max(1.0 / g2, 1.0), 3.0)) / (1.0 + g2)
                assert bends[c, one] == pytest.approx(share * float(np.linalg.norm(bend)), rel=1e-6)

    def test_smoothed_rows(self, n_sources: int) -> None:
        """Against the Gaussian of all states and readings together, conditioned on the readings."""
        at = smoothed_rows(n_sources)
        found = row_filter.smooth(at.tracks, at.prior, at.steps, at.rows)
        k, N = len(at.board.z), at.prior.x.shape[1]
        for c, (expected, after, left, covariance_z) in enumerate(at.gaussians):
            sigma = np.sqrt(np.diagonal(after))
            offsets = np.pad(found.offsets[c], ((0, 0), (0, 3)))
            offsets[-1] = found.last.x[c]
            error = ((offsets.ravel() - expected) / sigma).reshape(-1, N)
            assert np.abs(error[:, :-3]).max() < 1e-4
            assert np.abs(error[-1]).max() < 1e-4
            unit = np.outer(sigma[-N:], sigma[-N:])
            np.testing.assert_allclose(covariance(found.last.S[c]) / unit, after[-N:, -N:] / unit, atol=1e-4)
            square = float(left @ np.linalg.solve(covariance_z, left))
            first = float(left[:k] @ np.linalg.solve(covariance_z[:k, :k], left[:k]))
            assert found.nis[c] == pytest.approx(square - first, abs=1e-3)
            log_evidence = -0.5 * square - 0.5 * float(np.linalg.slogdet(covariance_z)[1])
            assert found.log_evidence[c] == pytest.approx(log_evidence, abs=1e-3)

    def test_followed_rows_are_predicted_and_updated_one_by_one(self, n_sources: int) -> None:
        """To the row that contradicts: readings of 100 σ; and to the first one where nothing may bend."""
        board, motion, n_rows = Board(n_sources, 30 + n_sources), OrnsteinUhlenbeck(0.3, 1.8, 1.5), 5
        state = Gaussians(board.gaussians.x[:1].copy(), board.gaussians.S[:1].copy(), n_sources, 3, power=0)
        readings = board.exact + np.random.default_rng(n_sources).normal(size=(n_rows, len(board.z)))
        readings[3, 7] += 100.0
        rows = board.repeat(readings)
        steps = row_filter.steps_problem(
            motion, [0.02], np.zeros(n_rows, dtype=np.intp), (np.ones((1, 3)), np.full((1, 3), 1e-7))
        )
        N = state.x.shape[1]
        for largest_bend, n_followed in ((math.inf, 3), (0.0, 0)):
            now, progress = replace(state, x=state.x.copy(), S=state.S.copy()), np.array([0, 1, 1])
            predicted, after = (replace(state, x=np.empty((5, N)), S=np.empty((5, N, N))) for _ in range(2))
            nis, innovation = np.empty(n_rows), np.empty((n_rows, len(board.z)))
            means, covariances = np.empty((n_rows, n_sources, 6)), np.empty((n_rows, n_sources, 6, 6))
            work = core.problem(
                "track",
                rows=rows.problem,
                motion=steps,
                convergence=row_filter.convergence(),
                nis_limits=np.full(len(board.z) + 1, chi2.isf(1e-6, len(board.z))),
                largest_width=1.0,
                largest_bend=largest_bend,
                longest_memory=10,
                largest_growth=0.0,  # predictions are straight, as those of the steps below
                full_count=0,
                least_share=0.02,
                state=now.problem,
                centroid=board.centroid.copy(),
                open_loop=np.zeros((n_sources, board.n, board.n)),
                progress=progress,
                predicted=predicted.problem,
                updated=after.problem,
                means=means,
                covariances=covariances,
                estimability=np.empty((n_rows, n_sources, 6)),
                nis=nis,
                innovation=innovation,
                correction=np.empty(n_rows),
                iterations=np.empty(n_rows, dtype=np.int64),
            )
            core.run("follow_sources", work, n_rows, block=2, chain=n_rows)
            assert progress.tolist() == [n_followed, 0, 1 + n_followed]
            expected = state
            for row in range(n_followed):
                expected = row_filter.predict(expected, board.centroid, steps, rows, row)
                np.testing.assert_array_equal(predicted.x[row], expected.x[0])
                updates = row_filter.update(expected, rows, row, innovation=True)
                expected = updates.after
                assert nis[row] == updates.nis[0]
                np.testing.assert_array_equal(innovation[row], updates.whitened_innovation(0))
                of_sources = expected.x[0, :-3].reshape(n_sources, board.n)
                S = expected.S[0, :-3].reshape(n_sources, board.n, N)[:, :6]
                chart = Chart.at(of_sources, board.centroid, rows.array.circumradius)
                mean, covariance = component_moments(chart, S)  # of places: moments fall by another power here
                np.testing.assert_allclose(means[row, :, :3], mean[:, :3], rtol=1e-12)
                np.testing.assert_allclose(covariances[row, :, :3, :3], covariance[:, :3, :3], rtol=1e-9, atol=1e-18)
                np.testing.assert_array_equal(after.S[row], expected.S[0])
            np.testing.assert_array_equal(now.x, expected.x)
