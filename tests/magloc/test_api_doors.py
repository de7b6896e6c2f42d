"""The doors of magloc other than fixes and tracks, as a user types them.

====================================  ==================================================================================
what                                  who checks it
====================================  ==================================================================================
a calibrated board                    the true sensors that made the readings, within 5 σ of the calibration's own
bounds                                shapes; the inverse of the information; the compiled table of the maps
detection range                       its share of single directions and moments; the fourth root of the moment
maps                                  the same map streamed to a folder, resumed, and made by the command
====================================  ==================================================================================
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

import arrays
import magloc
from magloc.cli.app import main
from magloc.detection.detection_range import detection_ranges
from magloc.directions import sphere_directions
from magloc.fields import dipole
from magloc.readings import Readings
from magloc.truth import Truth

ARRAY = arrays.tetrahedron(1.5, noise_T=1e-9)
MOMENT = np.array([0.3, -0.2, 0.5])
SOURCE = magloc.Source([5, 0, 0.306], [100, 0, 0])


class Passage:
    """A board of six sensors that are not quite as its file says, and a source that passes it."""

    def __init__(self, seed: int = 0, n: int = 60) -> None:
        rng = np.random.default_rng(seed)
        self.nominal = arrays.grid(3, 2, 0.05, noise_T=2e-9)
        self.true = replace(self.nominal, sensors=tuple(self.moved(sensor, rng) for sensor in self.nominal.sensors))
        direction = rng.normal(size=(n, 3))
        path = direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.uniform(0.2, 0.3, (n, 1))
        fields = dipole.field(self.true.positions, path[:, None], MOMENT)
        values = self.true.readings_of(fields) + 2e-9 * rng.normal(size=(n, 18))
        self.readings = Readings(time_s=np.arange(float(n)), values_T=values)
        self.truth = Truth(np.arange(float(n)), path, np.tile(MOMENT, (n, 1)))

    @staticmethod
    def moved(sensor: arrays.Sensor, rng: np.random.Generator) -> arrays.Sensor:
        scale = np.eye(3) + rng.normal(0, 0.01, (3, 3))
        return replace(
            sensor,
            position_m=tuple(np.array(sensor.position_m) + rng.normal(0, 5e-4, 3)),
            calibration=arrays.Calibration.of("vector", scale, rng.normal(0, 1e-6, 3)),
        )


class TestCalibrate:
    PRIOR = magloc.CalibrationPrior(position_m=1e-3, gain=0.02, axes_rad=0.02, offset_T=2e-6)

    def test_on_a_path(self, tmp_path):
        """Story 6: within 5 σ in each of 90 numbers, one false alarm in 20,000."""
        case = Passage()
        calibration = magloc.calibrate(case.nominal, case.readings, truth=case.truth, prior=self.PRIOR)
        assert calibration.converged
        assert {d.name for d in calibration.unobservable} == {f"common offset along {axis}" for axis in "xyz"}
        assert abs(calibration.chi2 - calibration.dof) < 5.0 * np.sqrt(2.0 * calibration.dof)
        error = (calibration.array.positions - case.true.positions) / calibration.sigma[:, :3]
        offset = [s.calibration.offset_T for s in calibration.array.sensors]
        true = [s.calibration.offset_T for s in case.true.sensors]
        assert np.abs(error).max() < 5.0
        assert np.abs(np.subtract(offset, true) / calibration.sigma[:, 12:]).max() < 5.0
        arrays.write_array(tmp_path / "calibrated.toml", calibration.array)
        read = arrays.read_array(tmp_path / "calibrated.toml")
        np.testing.assert_allclose(read.positions, calibration.array.positions)
        assert isinstance(calibration.plot(), Figure)

    def test_alone(self):
        """Without a path the whole board may be moved, turned and scaled: the prior decides, and that is said."""
        case = Passage()
        calibration = magloc.calibrate(case.nominal, case.readings, prior=self.PRIOR)
        assert calibration.converged
        names = {direction.name for direction in calibration.unobservable}
        assert "translation along x" in names
        assert "size of the array against the moment" in names

    def test_height_that_the_truth_does_not_tell(self):
        case = Passage()
        flat = case.truth.position_m.copy()
        flat[:, 2] = 0.1
        fields = dipole.field(case.true.positions, flat[:, None], MOMENT)
        readings = replace(case.readings, values_T=case.true.readings_of(fields))
        unknown = flat.copy()
        unknown[:, 2] = np.nan
        truth = replace(case.truth, position_m=unknown)
        found = magloc.calibrate(case.nominal, readings, truth=truth, prior=self.PRIOR)
        np.testing.assert_allclose(found.position_m[:, 2], 0.1, atol=2e-3)

    def test_turned_in_a_field_of_known_modulus(self):
        """The part of S that the modulus tells, S Sᵀ, within 5 σ; everything else is as in the array file."""
        rng = np.random.default_rng(5)
        sensor = arrays.Sensor("m", "vector", (0.0, 0.0, 0.0), 5e-9)
        nominal = arrays.SensorArray((sensor,))
        true = Passage.moved(sensor, rng)
        directions = rng.normal(size=(400, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        scale = np.array(true.calibration.scale)
        values = 48e-6 * directions @ scale.T + true.calibration.offset_T + 5e-9 * rng.normal(size=(400, 3))
        readings = Readings(time_s=np.arange(400.0), values_T=values)
        calibration = magloc.calibrate(nominal, readings, modulus_T=48e-6)
        found = calibration.array.sensors[0].calibration
        assert calibration.converged
        assert [direction.name for direction in calibration.unobservable] == ["rotation of sensor m"]
        sigma = calibration.sigma[0]
        assert np.abs(np.subtract(found.offset_T, true.calibration.offset_T) / sigma[12:]).max() < 5.0
        root = np.linalg.cholesky(scale @ scale.T)  # one of all that have the same S Sᵀ
        left, _, right = np.linalg.svd(np.linalg.inv(root) @ np.array(found.scale))
        nearest = root @ left @ right
        assert np.abs(np.diagonal(nearest - found.scale) / sigma[3:6]).max() < 5.0
        np.testing.assert_array_equal(sigma[:3], 0.0)
        np.testing.assert_allclose(calibration.change[0, 3:6], np.diagonal(found.scale) - 1.0)
        assert isinstance(calibration.plot(), Figure)

    def test_a_modulus_and_a_path_contradict_each_other(self):
        case = Passage()
        with pytest.raises(ValueError, match="Input modulus_T must come without truth"):
            magloc.calibrate(case.nominal, case.readings, truth=case.truth, modulus_T=48e-6)

    def test_a_truth_of_another_time(self):
        case = Passage()
        with pytest.raises(ValueError, match="Input truth must have times of the readings"):
            magloc.calibrate(case.nominal, case.readings, truth=replace(case.truth, time_s=case.truth.time_s + 1e6))


class TestDesign:
    @pytest.mark.slow
    def test_story(self):
        """Story 7, with a quick search: a design betters its best start; its gain is over the best reference."""
        task = magloc.DesignTask.read("half-space-2m")
        search = replace(
            task.search, n_refined=1, log2_small=8, log2_large=9, small_iterations=4, large_iterations=8, n_judged=2000
        )
        done: list[int] = []
        design = magloc.design_array(replace(task, search=search), starts=2, rng=0, progress=done.append)
        assert design.array.n_sensors == task.n_sensors
        assert design.fitted_m <= design.start_m
        own, *others = (judged.criterion_m for judged in design.judged if judged.name != "best start")
        assert design.gain == pytest.approx(1.0 - own / min(others))
        assert sum(done) <= replace(search, n_starts=2).n_steps
        assert isinstance(design.plot(), Figure)

    def test_a_name_that_is_none(self):
        with pytest.raises(arrays.InputError, match="half-space-2m"):
            magloc.DesignTask.read("nowhere")


class TestBounds:
    def test_story(self):
        """Story 8: leading axes stay."""
        positions_m = 5.0 * sphere_directions(6).reshape(2, 3, 3)
        bounds = magloc.cramer_rao_bounds(ARRAY, positions_m, [0.0, 0.0, 100.0])
        assert bounds.covariance.shape == (2, 3, 6, 6)
        assert bounds.sigma_position_m.shape == bounds.sigma_moment_Am2.shape == (2, 3)
        variances = np.diagonal(bounds.covariance, axis1=-2, axis2=-1)
        np.testing.assert_allclose(bounds.sigma_position_m**2, variances[..., :3].sum(axis=-1))

    @pytest.mark.slow
    def test_detection_range(self):
        """A quantile over directions and moments; it grows with the fourth root of the moment, as differences fall."""
        found = magloc.detection_range(ARRAY, moment_Am2=1e3)
        detector = magloc.MatchedFilterDetector.of(ARRAY, n_draws=20_000)
        moments = magloc.moments_on_sphere(1e3)
        every = detection_ranges(ARRAY, sphere_directions(100), moments, detector)
        assert np.mean(every >= found) == pytest.approx(0.5, abs=1e-3)
        nearly_sure = magloc.detection_range(ARRAY, moment_Am2=1e5, share=0.95)
        far = np.quantile(every, 0.05) * 100.0**0.25
        assert nearly_sure == pytest.approx(far, rel=0.02)


class TestMaps:
    def test_story(self, tmp_path):
        """Story 9, coarse: the same map in memory, streamed to a folder, resumed, and by the command."""
        converged = magloc.convergence_map(ARRAY, SOURCE, method="repeated", edge_m=40, n=5)
        assert isinstance(magloc.plots.convergence(converged), Figure)
        counted: list[int] = []
        streamed = magloc.convergence_map(ARRAY, SOURCE, edge_m=40, n=5, out=tmp_path / "map.zarr")
        xr.testing.assert_equal(streamed, converged)
        again = magloc.convergence_map(
            ARRAY, SOURCE, edge_m=40, n=5, out=tmp_path / "map.zarr", progress=counted.append
        )
        assert counted == [125]
        assert again.attrs["seconds"] == streamed.attrs["seconds"]

    def test_the_command_makes_the_same_map(self, tmp_path):
        (tmp_path / "array.toml").write_text(
            'geometry = "tetrahedron"\nedge_m = 1.5\nkind = "vector"\nnoise_nT = 1.0\n'
        )
        (tmp_path / "mine.toml").write_text(
            'array = "array.toml"\nhalf_width_m = 20.0\n'
            "[source]\nposition_m = [5, 0, 0.306]\nmoment_Am2 = [100, 0, 0]\n"
        )
        assert main(["map", str(tmp_path / "mine.toml"), "--grid", "5", "--out", str(tmp_path), "--quiet"]) == 0
        array = arrays.read_array(tmp_path / "array.toml")
        expected = magloc.convergence_map(array, SOURCE, edge_m=40, n=5)
        with xr.open_zarr(tmp_path / "map.zarr") as dataset:
            xr.testing.assert_equal(dataset.drop_vars("seconds_of_chunk").load(), expected)

    def test_over_sources(self):
        found = magloc.source_map(ARRAY, 300.0, edge_m=8.0, n=5, farthest_m=4.0, rng=3)
        assert set(np.unique(found.status)) <= {0, 1, 2, 3}
        assert (found.status == 0).sum() > 10
        assert isinstance(magloc.plots.sources(found), Figure)

    def test_of_bounds(self):
        cube = magloc.bound_map(ARRAY, (0.0, 0.0, 100.0), edge_m=8.0, n=4, n_moments=5)
        place = np.stack([cube.x[0], cube.y[1], cube.z[2]]) + ARRAY.centroid
        direct = magloc.cramer_rao_bounds(ARRAY, place, [0.0, 0.0, 100.0])
        assert float(cube.sigma_range[0, 1, 2]) == pytest.approx(float(direct.sigma_range_m), rel=1e-6)

    @pytest.mark.parametrize(
        ("options", "expected"),
        [
            ({"method": "newton"}, "Input method must be one of repeated, iekf, damped, global"),
            ({"edge_m": 0.0}, "Input edge_m must be positive"),
            ({"n": 1}, "must be at least 2"),
            ({"scheduler": "nonsense"}, "scheduler: found 'nonsense'"),
        ],
    )
    def test_bad_input(self, options, expected):
        with pytest.raises(ValueError, match=expected):
            magloc.convergence_map(ARRAY, SOURCE, **options)


def test_errors_of_the_library_do_not_speak_of_options():
    """A command adds its options to them."""
    with pytest.raises(ValueError, match="scheduler") as caught:
        magloc.bound_map(ARRAY, (0.0, 0.0, 1.0), n=2, scheduler="x")
    assert "--" not in str(caught.value)
