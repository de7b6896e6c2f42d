"""Maps of Cramér-Rao bounds.

| what | who checks it |
|---|---|
| values of every map | magloc.bounds.crlb.cramer_rao_bounds at the points' own coordinates, NumPy's quantiles |
| reach | the root of magloc.bounds.crlb.cramer_rao_bounds by SciPy; a scan over distances |
| a map in boxes, on disk | the same in memory |
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import brentq

from arrays.array import SensorArray
from arrays.geometries import cube, tetrahedron
from magloc.bounds.crlb import cramer_rao_bounds
from magloc.bounds.maps import (
    CASES,
    AccuracyReach,
    BoundMap,
    BoundScenario,
    bound_map,
    bound_slices,
    bounds_at,
    summary,
)
from magloc.bounds.spheres import accuracy_ranges, bound_spheres
from magloc.directions import sphere_directions
from magloc.grids.computed import computed_map
from magloc.grids.cube import boxes, computed
from magloc.grids.store import Sweep, open_map

SCENARIO = BoundScenario(moment_Am2=(60.0, 50.0, 60.0), half_width_m=8.0, n_moments=21)
MOVED = replace(
    SCENARIO,
    array=SensorArray(
        tuple(replace(s, position_m=s.position_m + np.array([1.0, -2.0, 0.5])) for s in tetrahedron(1.0).sensors)
    ),
)


class InBoxes(BoundMap):
    """A map whose boxes are small though they take no time."""

    edge = 20


QUANTITIES = {"range": "sigma_range_m", "bearing": "sigma_bearing_rad", "position": "sigma_position_m"}


def direct(scenario, position):
    """All values at one position, by cramer_rao_bounds and NumPy."""
    one = cramer_rao_bounds(scenario.array, position, scenario.moment_Am2)
    many = cramer_rao_bounds(scenario.array, position, scenario.moments_Am2)
    values = {}
    for name, attribute in QUANTITIES.items():
        sigmas = getattr(many, attribute)
        median, q95 = np.quantile(sigmas, [0.5, 0.95], method="inverted_cdf")
        expected = (getattr(one, attribute), median, q95, sigmas.max())
        values |= {f"sigma_{name}{case}": value for case, value in zip(CASES, expected, strict=True)}
    return values


def assert_same(values, expected):
    for name, value in expected.items():
        assert_allclose(values[name], value, rtol=1e-8, err_msg=name)


class TestCube:
    def test_values_are_the_bounds_at_its_points(self):
        dataset = computed_map(BoundMap(MOVED, 4))
        assert_array_equal(dataset.attrs["centroid_m"], MOVED.array.centroid)
        for x, y, z in ((0, 0, 0), (1, 2, 3), (3, 1, 2)):
            point = dataset.isel(x=x, y=y, z=z)
            place = MOVED.array.centroid + np.array([point.x, point.y, point.z])
            assert_same(point, direct(MOVED, place))

    def test_the_ambient_field_of_moduli_is_exact_where_nothing_is_said(self):
        array = replace(cube(1.0, "scalar", 1e-10), ambient_T=(2e-5, 0.0, 4e-5))
        dataset = bound_map(array, (60.0, 50.0, 60.0), edge_m=8.0, n=2, n_moments=3)
        point = dataset.isel(x=0, y=1, z=1)
        place = array.centroid + np.array([point.x, point.y, point.z])
        exact = cramer_rao_bounds(array, place, (60.0, 50.0, 60.0))
        assert_allclose(point.sigma_range, exact.sigma_range_m, rtol=1e-6)

    def test_reached_counts_the_moments_that_are_accurate_enough(self):
        dataset = computed_map(BoundMap(SCENARIO, 9))
        ranks = [(dataset[f"sigma_range{case}"] <= SCENARIO.accuracy_m).astype(int) for case in CASES[1:]]
        defined = dataset.reached != AccuracyReach.UNDEFINED
        assert_array_equal(dataset.reached.to_numpy()[defined], sum(ranks).to_numpy()[defined])
        assert set(np.unique(dataset.reached)) == {-1, 0, 1, 2, 3}
        assert int((~defined).sum()) == 1  # the centroid, which has no direction
        assert np.isnan(dataset.sigma_range.sel(x=0.0, y=0.0, z=0.0))

    def test_neither_boxes_nor_the_store_change_it(self, tmp_path):
        small = replace(SCENARIO, n_moments=3)
        cube_map = InBoxes(small, 40)
        assert len(list(boxes(cube_map))) == 8
        with Sweep(cube_map, tmp_path / "map.zarr") as sweep:
            sweep.write(map(partial(computed, cube_map), sweep.unfinished()))
        with open_map(tmp_path / "map.zarr") as stored:
            # All at once, without boxes.
            places = np.stack(np.meshgrid(*3 * [cube_map.axis], indexing="ij"), axis=-1)
            whole = bounds_at(small, small.array.centroid + places)
            for name, values in whole.items():
                assert_array_equal(stored[name], values)
            counts = summary(stored)
            assert counts.points == 40**3
            assert counts.fraction == (stored.reached >= AccuracyReach.MOST).mean()

    def test_describes_itself(self):
        dataset = computed_map(BoundMap(SCENARIO, 2))
        for variable in (*dataset.data_vars.values(), *dataset.coords.values()):
            assert variable.attrs["long_name"]
            assert "units" in variable.attrs or "flag_values" in variable.attrs
        for key in ("Conventions", "source", "array", "moment_Am2", "n_moments", "accuracy_m", "half_width_m"):
            assert key in dataset.attrs

    def test_survives_netcdf(self, tmp_path):
        dataset = computed_map(BoundMap(SCENARIO, 3))
        dataset.to_netcdf(tmp_path / "cube.nc")
        with xr.open_dataset(tmp_path / "cube.nc") as again:
            xr.testing.assert_equal(again, dataset)


class TestSlices:
    def test_values_are_the_bounds_on_the_planes(self):
        dataset = bound_slices(MOVED, 6)
        for plane in ("xy", "xz", "yz"):
            part = dataset.sel(plane=plane).isel(across=1, up=4)
            place = MOVED.array.centroid.copy()
            place["xyz".index(plane[0])] += float(part.across)
            place["xyz".index(plane[1])] += float(part.up)
            assert_same(part, direct(MOVED, place))


class TestSpheres:
    def test_values_are_the_bounds_on_the_spheres(self):
        dataset = bound_spheres(MOVED, [2.0, 5.0], step_deg=30.0)
        for range_m, elevation, azimuth, direction in (
            (2.0, 0.0, 90.0, (0.0, 1.0, 0.0)),
            (5.0, 90.0, -60.0, (0.0, 0.0, 1.0)),
            (5.0, 30.0, 180.0, (-np.sqrt(0.75), 0.0, 0.5)),
        ):
            point = dataset.sel(range=range_m, elevation=elevation, azimuth=azimuth)
            assert_same(point, direct(MOVED, MOVED.array.centroid + range_m * np.array(direction)))

    def test_names_units_and_reach(self):
        dataset = bound_spheres(SCENARIO, [3.0], step_deg=45.0)
        assert dataset.accuracy_range_q95.dims == ("elevation", "azimuth")
        assert all(v.attrs["units"] for v in (*dataset.data_vars.values(), *dataset.coords.values()))
        assert_allclose(dataset.accuracy_range.sel(azimuth=180.0), dataset.accuracy_range.sel(azimuth=-180.0))

    @pytest.mark.parametrize(
        ("ranges", "step", "text"),
        [([0.0], 5.0, "Input ranges_m"), ([np.inf], 5.0, "Input ranges_m"), ([1.0], 7.0, "Input step_deg"),
         ([1.0], 0.0, "Input step_deg"), ([1.0], -5.0, "Input step_deg")],
    )  # fmt: skip
    def test_wrong_input(self, ranges, step, text):
        with pytest.raises(ValueError, match=text):
            bound_spheres(SCENARIO, ranges, step)


class TestReach:
    @pytest.mark.parametrize("array", [tetrahedron(1.5), cube(1.0)], ids=["tetrahedron", "cube"])
    def test_is_the_root_of_the_bound(self, array):
        scenario = replace(SCENARIO, array=array)
        directions = sphere_directions(7)
        reach = accuracy_ranges(scenario, directions)
        for direction, found in zip(directions, reach, strict=True):
            for case, distance in zip(CASES, found, strict=True):

                def excess(r, case=case, direction=direction):
                    return np.log(direct(scenario, r * direction)[f"sigma_range{case}"] / scenario.accuracy_m)

                root = brentq(excess, 0.97 * distance, 1.03 * distance, xtol=1e-9)
                assert abs(distance / root - 1.0) < 1e-4

    def test_is_the_largest_distance(self):
        # What is nearer may be worse, what is farther never is.
        directions = sphere_directions(40)
        reach = accuracy_ranges(SCENARIO, directions)
        for factor in np.geomspace(1.001, 5.0, 12):
            for i, case in enumerate(CASES):
                places = factor * reach[:, i, None] * directions
                assert np.all(bounds_at(SCENARIO, places)[f"sigma_range{case}"] > SCENARIO.accuracy_m)
        assert np.all(reach[:, 1] >= reach[:, 2])
        assert np.all(reach[:, 2] >= reach[:, 3])

    def test_scales_with_the_moment_as_far_sources_do(self):
        # σ_range is as r⁶ far away, so a reach that is far is as the sixth root of moment and accuracy.
        directions = sphere_directions(10)
        small = replace(SCENARIO, array=tetrahedron(0.01, noise_T=1e-15), accuracy_m=1e-2)
        strong = replace(small, moment_Am2=tuple(64.0 * m for m in small.moment_Am2))
        assert_allclose(accuracy_ranges(strong, directions) / accuracy_ranges(small, directions), 2.0, rtol=0.01)

    def test_is_zero_where_no_distance_will_do(self):
        weak = replace(SCENARIO, moment_Am2=(1e-9, 0.0, 0.0))
        assert_array_equal(accuracy_ranges(weak, np.eye(3)), 0.0)
        four = replace(SCENARIO, array=replace(tetrahedron(1.5, kind="scalar"), ambient_T=(0.0, 0.0, 5e-5)))
        assert_array_equal(accuracy_ranges(four, np.eye(3)), 0.0)


class TestScenario:
    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("half_width_m", 0.0),
            ("half_width_m", np.inf),
            ("accuracy_m", -1.0),
            ("moment_Am2", (0.0, 0.0, 0.0)),
            ("moment_Am2", (np.nan, 0.0, 0.0)),
            ("n_moments", 0),
            ("array", tetrahedron(1.5, noise_T=1e-25)),
        ],
    )
    def test_refuses_nonsense(self, name, value):
        with pytest.raises(ValueError, match=f"Input {name}"):
            replace(SCENARIO, **{name: value})

    def test_a_grid_has_two_points_at_least(self):
        with pytest.raises(ValueError, match="Input grid must be at least 2"):
            computed_map(BoundMap(SCENARIO, 1))
        with pytest.raises(ValueError, match="Input grid must be at least 2"):
            bound_slices(SCENARIO, 1)

    def test_any_noise_and_sensors(self):
        # Noise that depends on the readings, and an ambient field that is not known exactly.
        fraction = replace(SCENARIO, array=replace(tetrahedron(1.5), noise_fraction=0.01))
        scalars = replace(
            SCENARIO,
            array=replace(cube(1.5, kind="scalar", noise_T=1e-11), ambient_T=(2e-5, 0.0, 4e-5)),
            ambient_uncertainty_T=1e-7,
        )
        for scenario in (fraction, scalars):
            known = replace(scenario, array=replace(scenario.array, noise_fraction=0.0), ambient_uncertainty_T=0.0)
            place = np.array([[3.0, 1.0, 2.0]])
            worse, better = bounds_at(scenario, place), bounds_at(known, place)
            assert all(worse[name] > better[name] for name in worse)
