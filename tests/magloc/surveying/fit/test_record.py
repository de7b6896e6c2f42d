"""Rows of a survey as measurements of sources in the world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import arrays
from arrays.typing import FloatArray
from magloc.fields import dipole
from magloc.measurement.pose import PoseErrors
from magloc.measurement.rows import concatenate_readings
from magloc.readings import Readings
from magloc.surveying.fit.record import SurveyRecord, shortest_turns

RNG = np.random.default_rng(3)
N = 6
POSE = arrays.PoseUncertainty(0.02, 0.01, 0.0, 5.0, 0.03, 0.02, 0.0, (0.1, -0.2, 0.5))
TIME = np.arange(float(N))
PLACES = np.column_stack([TIME, 0.3 * TIME, 1.0 + 0.1 * TIME])
TURNS = Rotation.from_rotvec(0.3 * RNG.standard_normal((N, 3)))
AMBIENT = np.array([2e-6, 20e-6, -44e-6])
SOURCE = (np.array([[2.5, 1.0, -0.6]]), np.array([[3.0, -8.0, 5.0]]))
SCALAR = arrays.SensorArray(
    tuple(arrays.Sensor(name, "scalar", (0.0, 0.0, z), noise_T=1e-10) for name, z in (("low", 0.0), ("high", 1.0))),
    pose=POSE,
)
VECTOR = arrays.SensorArray(arrays.tetrahedron(0.6).sensors, pose=POSE)


def readings_of(array: arrays.SensorArray, places: FloatArray, turns: Rotation) -> FloatArray:
    """What sensors read at places and attitudes that may not be the stated ones."""
    R = turns.as_matrix()
    sensors = places[:, None] + np.einsum("nij,sj->nsi", R, array.positions)
    fields = AMBIENT + dipole.total_field(sensors, *SOURCE)
    return array.readings_of(np.einsum("nji,nsj->nsi", R, fields))


def record_of(array: arrays.SensorArray, values: FloatArray) -> SurveyRecord:
    ambient = TURNS.inv().apply(np.tile(AMBIENT, (N, 1)))
    rows = Readings(values, time_s=TIME, array_position_m=PLACES, array_rotation=TURNS, ambient_T=ambient)
    return SurveyRecord.of(array, rows, ambient, PoseErrors.of(array.pose))


class TestPredictions:
    """Are what the rows are of, to rounding, where the pose is exact."""

    @pytest.mark.parametrize("array", [SCALAR, VECTOR], ids=["scalar", "vector"])
    def test_exact_pose(self, array: arrays.SensorArray) -> None:
        record = record_of(array, readings_of(array, PLACES, TURNS))
        np.testing.assert_allclose(record.predict(record.fields(*SOURCE)), record.values_T, atol=1e-17)

    def test_attitude_of_vector_sensors_hardly_matters(self) -> None:
        """Half a degree moves the ambient field by 400 nT; what is left is a turn of the source's field."""
        wrong = TURNS * Rotation.from_rotvec([0.005, -0.006, 0.0])
        record = record_of(VECTOR, readings_of(VECTOR, PLACES, wrong))
        left = record.predict(record.fields(*SOURCE)) - record.values_T
        # The lever arms of the sensors move too, by 2 mm.
        assert np.abs(left).max() < 0.02 * np.abs(record.values_T).max()

    def test_a_modulus_does_not_cancel(self) -> None:
        """A tenth of a picotesla beside 50,000 nT: the product form, against extended precision."""
        record = record_of(SCALAR, readings_of(SCALAR, PLACES, TURNS))
        small = record.fields(SOURCE[0], 1e-6 * SOURCE[1])
        b = np.longdouble(1.0) * record.ambient_T[:, None]
        exact = np.sqrt(np.sum((b + small) ** 2, axis=-1)) - np.sqrt(np.sum(b**2, axis=-1))
        np.testing.assert_allclose(record.predict(small), exact.astype(float), rtol=2e-5)


class TestDerivatives:
    """By finite differences of the readings."""

    STEP = 1e-4

    def test_directions(self) -> None:
        record = record_of(SCALAR, readings_of(SCALAR, PLACES, TURNS))
        fields = record.fields(*SOURCE)
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = 1e-11
            numeric = (record.predict(fields + step) - record.predict(fields - step)) / 2e-11
            np.testing.assert_allclose(record.directions(fields)[..., axis], numeric, atol=1e-6)

    @pytest.mark.parametrize("axis", range(3))
    def test_shift(self, axis: int) -> None:
        for array in (SCALAR, VECTOR):
            step = np.zeros(3)
            step[axis] = self.STEP
            values = [record_of(array, readings_of(array, PLACES + s * step, TURNS)).values_T for s in (1, -1)]
            numeric = (values[0] - values[1]) / (2.0 * self.STEP) * POSE.position_m
            record = record_of(array, readings_of(array, PLACES, TURNS))
            fields = record.fields(*SOURCE)
            gradients = dipole.total_gradient_tensor(record.sensors_m, *SOURCE)
            found = record.by_pose(record.directions(fields), fields, gradients)[..., 3 + axis]
            if array is VECTOR:
                # What is across the ambient field of the sensors' mean is zero in the turned axes.
                unit = AMBIENT / np.linalg.norm(AMBIENT)
                mean = found.reshape(N, -1, 3).mean(axis=1)
                across = mean - (mean @ unit)[:, None] * unit
                found = (found.reshape(N, -1, 3) - across[:, None]).reshape(N, -1)
            # But for the ratio of the source's field to the ambient one, 1 % here.
            np.testing.assert_allclose(found, numeric, rtol=1e-2, atol=1e-2 * np.abs(numeric).max())


class TestCarrier:
    """Tolles and Lawson's terms: what carries the sensors is magnetised by the field that it turns in."""

    @pytest.mark.parametrize("kind", ["scalar", "vector"])
    def test_columns_are_what_readings_have_more(self, kind: str) -> None:
        """Permanent, induced and eddy-current fields of random coefficients, in closed form."""
        sensor = arrays.Sensor(
            "s",
            kind,  # type: ignore[arg-type]  # one of the two
            (0.0, 0.0, 0.0),
            noise_T=1e-10,
            offset_uncertainty_T=2e-9,
            induced_uncertainty=1e-4,
            eddy_uncertainty_s=3e-4,
        )
        array = arrays.SensorArray((sensor,), pose=POSE)
        ambient = TURNS.inv().apply(np.tile(AMBIENT, (N, 1)))
        coefficients = np.random.default_rng(7).standard_normal(21)
        p, A, E = 2e-9 * coefficients[:3], 1e-4 * coefficients[3:12], 3e-4 * coefficients[12:]
        more = p + ambient @ A.reshape(3, 3).T + np.gradient(ambient, TIME, axis=0) @ E.reshape(3, 3).T
        rows = Readings(
            array.readings_of((ambient + more)[:, None]),
            time_s=TIME,
            array_position_m=PLACES,
            array_rotation=TURNS,
            ambient_T=ambient,
        )
        record = SurveyRecord.of(array, rows, ambient, PoseErrors.of(POSE))
        columns = record.by_sensors(record.directions(np.zeros((N, 1, 3)))) @ coefficients
        unit = AMBIENT / np.linalg.norm(AMBIENT)
        if kind == "vector":  # across the ambient field the mean of the sensors is zero in the turned axes
            columns, values = columns @ unit, record.values_T @ unit
        else:
            columns, values = columns[:, 0], record.values_T[:, 0]
        # But for the square of what is added over the ambient field.
        np.testing.assert_allclose(columns, values, atol=1e-3 * np.abs(values).max())

    def test_what_an_error_of_the_attitude_leaves_of_them(self) -> None:
        """Standard deviation over 20,000 carriers and turns: within 3 %, six deviations of that of so many."""
        induced, turn = 3e-4, 0.01
        sensor = arrays.Sensor("s", "scalar", (0.0, 0.0, 0.0), noise_T=1e-10, induced_uncertainty=induced)
        pose = arrays.PoseUncertainty(0.02, turn)
        array = arrays.SensorArray((sensor,), pose=pose)
        ambient = TURNS.inv().apply(np.tile(AMBIENT, (N, 1)))
        rows = Readings(np.ones((N, 1)), time_s=TIME, array_position_m=PLACES, array_rotation=TURNS, ambient_T=ambient)
        errors = PoseErrors.of(pose)
        lasting, white = SurveyRecord.of(array, rows, ambient, errors).by_turned_carrier(errors, 1e-15)
        assert white.shape == (N, 1, 0)
        rng, b = np.random.default_rng(9), ambient[0]
        A = induced * rng.standard_normal((20_000, 3, 3))
        turned = Rotation.from_rotvec(turn * rng.standard_normal((20_000, 3))).apply(b)
        reads = [
            np.einsum("ki,kij,kj->k", along, A, along) / np.linalg.norm(b)
            for along in (turned, np.tile(b, (20_000, 1)))
        ]
        assert np.std(reads[0] - reads[1]) == pytest.approx(lasting[0, 0, 0], rel=0.03)


class TestSquaredShift:
    """What the square of a shift adds to fields, which first order does not know."""

    SIGMA_M = 1e-3

    def columns(self, least_T: float) -> tuple[SurveyRecord, FloatArray]:
        array = replace(SCALAR, pose=arrays.PoseUncertainty(self.SIGMA_M, 0.01, 0.0, 5.0))
        record = record_of(array, readings_of(array, PLACES, TURNS))
        return record, record.by_squared_shift(record.directions(record.fields(*SOURCE)), *SOURCE, least_T)

    def test_covariance(self) -> None:
        """That of the even part of the field over shifts that are Gaussian, by quadrature."""
        record, found = self.columns(1e-18)
        directions = record.directions(record.fields(*SOURCE))
        node, weight = np.polynomial.hermite_e.hermegauss(4)
        shifts = self.SIGMA_M * np.stack(np.meshgrid(node, node, node), axis=-1).reshape(-1, 3)
        weights = np.prod(np.stack(np.meshgrid(weight, weight, weight), axis=-1), axis=-1).ravel() / weight.sum() ** 3
        here = dipole.total_field(record.sensors_m, *SOURCE)
        ends = [[dipole.total_field(record.sensors_m + s * shift, *SOURCE) for shift in shifts] for s in (1.0, -1.0)]
        even = np.einsum("nci,qnci->qnc", directions, 0.5 * np.sum(ends, axis=0) - here)
        expected = np.einsum("q,qna,qnb->nab", weights, even, even)
        np.testing.assert_allclose(found @ found.mT, expected, rtol=1e-3, atol=1e-4 * expected.max())
        np.testing.assert_allclose(weights @ even.reshape(len(weights), -1), 0.0, atol=1e-4 * np.abs(even).max())

    def test_where_it_is_negligible(self) -> None:
        """There are no columns, and none is left out that is larger than what is said."""
        _, found = self.columns(1e-18)
        largest = np.linalg.norm(found, axis=2).max()
        assert self.columns(10.0 * largest)[1].shape[2] == 0
        kept = self.columns(0.5 * largest)[1]
        assert np.linalg.norm(found - kept, axis=2).max() < 0.5 * largest


class TestTurns:
    def test_lay_one_along_the_other(self) -> None:
        a, b = RNG.standard_normal((2, 50, 3))
        R = shortest_turns(a, b)
        turned = np.einsum("nij,nj->ni", R, a)
        np.testing.assert_allclose(np.cross(turned, b), 0.0, atol=1e-12)
        assert (np.sum(turned * b, axis=1) > 0.0).all()
        np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)


class TestSeveralFiles:
    ROWS = Readings(np.zeros((3, 2)), time_s=[0.0, 1.0, 2.0], ambient_T=np.ones((3, 3)))

    def test_one_after_the_other(self) -> None:
        later = replace(self.ROWS, time_s=self.ROWS.time_s + 3.0)
        assert concatenate_readings([self.ROWS, later]).time_s.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]

    def test_other_columns(self) -> None:
        with pytest.raises(ValueError, match="same columns"):
            concatenate_readings([self.ROWS, replace(self.ROWS, ambient_T=None)])
