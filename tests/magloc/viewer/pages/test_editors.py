"""A dipole and sensors that the user moves: the numbers behind them, and the scene and the panels that follow.

No browser: what the page would send is given to the server's own handlers, and what it would draw is read from the
nodes of the scene. Field and Jacobian are magpylib's; the Cramér-Rao bound is made from them with the common field as
three unknowns more, while the project takes differences.
"""

import asyncio
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, ncx2
from viser._messages import TransformControlsUpdateMessage

from arrays.array import SensorArray
from arrays.array_file import read_array, write_array
from arrays.geometries import axial, cube, square, tetrahedron
from arrays.sensor import Calibration
from magloc.levels import FALSE_ALARM
from magloc.localization.fit.results import Fix
from magloc.localization.uncertainty.range_interval import gaussian_ranges
from magloc.measurement.differences import suitable_dipole
from magloc.viewer.pages.array_editor import ArrayEditor, move_sensor, path_fault
from magloc.viewer.pages.dipole_editor import DipoleEditor, angles_of, direction_of, input_step
from magloc.viewer.pages.live_fit import LiveFit
from magloc.viewer.pages.texts import panel_html
from magloc.viewer.panels.coalesced import CoalescedCall
from magloc.viewer.panels.inputs import set_value
from magloc.viewer.scene.glyphs import rotation_from_z
from tests.magloc.viewer.conftest import node
from tests.oracles import derivative, magpylib_field
from tests.plain_locator import plain_locator
from tests.waiting import WAIT_S, wait_for

SMALL, LARGE = tetrahedron(0.03), cube(30.0)


def drag(server: viser.ViserServer, control: viser.TransformControlsHandle, position_m, wxyz=None) -> None:
    """What a page sends while the user drags."""
    turned = control.wxyz if wxyz is None else wxyz
    message = TransformControlsUpdateMessage(
        control.name, tuple(map(float, turned)), tuple(map(float, position_m)), owner=""
    )
    handle = server.scene._handle_transform_controls_updates(0, message)
    asyncio.run_coroutine_threadsafe(handle, server.get_event_loop()).result(WAIT_S)


def bound_with_unknown_common_field(array: SensorArray, position, moment) -> np.ndarray:
    """Cramér-Rao bound (6, 6) of uncalibrated vector sensors, the common field being unknown too."""
    # The part of the noise that is proportional to the field counts what differs from the sensors' mean.
    fields = magpylib_field(array.positions, position, moment)
    modulus = np.linalg.norm(fields - fields.mean(axis=0), axis=1)
    noise = np.array([sensor.noise_T for sensor in array.sensors])
    sigma = np.repeat(np.hypot(noise, array.noise_fraction * modulus), 3)
    scale = np.array([array.circumradius] * 3 + [np.linalg.norm(moment)] * 3)

    def readings(unknown: np.ndarray) -> np.ndarray:
        many = np.atleast_2d(unknown * scale)
        fields = [magpylib_field(array.positions, row[:3], row[3:]).ravel() for row in many.reshape(-1, 6)]
        return np.reshape(fields, (*np.shape(unknown)[:-1], -1)) / sigma

    state = np.concatenate([position, moment])
    jacobian = derivative(readings, state / scale, step=1e-2)
    common = np.tile(np.eye(3), (array.n_sensors, 1)) / sigma[:, None] * sigma.min()
    both = np.hstack([jacobian, common])
    return np.linalg.inv(both.T @ both)[:6, :6] * np.outer(scale, scale)


class TestForecast:
    def test_readings_of_turned_and_calibrated_sensors_are_those_of_magpylib(self):
        rng = np.random.default_rng(1)
        rotations = Rotation.random(4, random_state=2)
        scales = np.eye(3) + 0.05 * rng.standard_normal((4, 3, 3))
        offsets = 1e-6 * rng.standard_normal((4, 3))
        array = replace(
            SMALL,
            sensors=tuple(
                replace(sensor, rotation_xyzw=rotations[i].as_quat(), calibration=Calibration(scales[i], offsets[i]))
                for i, sensor in enumerate(SMALL.sensors)
            ),
            ambient_T=(2e-5, 1e-6, -4e-5),
        )
        position, moment = np.array([0.06, -0.02, 0.04]), np.array([1e-3, 2e-3, -5e-4])
        forecast = LiveFit(array).forecast(position, moment)
        source = magpylib_field(array.positions, position, moment)
        body = rotations.inv().apply(source + array.ambient_T)
        expected = np.einsum("nij,nj->ni", scales, body) + offsets
        np.testing.assert_allclose(forecast.readings_T, expected.ravel(), rtol=1e-12)
        signal = np.einsum("nij,nj->ni", scales, rotations.inv().apply(source))
        np.testing.assert_allclose(forecast.signal_T, signal.ravel(), rtol=1e-6, atol=1e-18)

    def test_scalar_sensors_read_the_modulus_of_the_whole_field(self):
        array = replace(cube(1.0, "scalar", 1e-11), ambient_T=(2e-5, 0.0, -4e-5))
        position, moment = suitable_dipole(array)
        source = magpylib_field(array.positions, position, moment)
        expected = np.linalg.norm(source + array.ambient_T, axis=1)
        np.testing.assert_allclose(LiveFit(array).forecast(position, moment).readings_T, expected, rtol=1e-13)

    @pytest.mark.parametrize(
        "array",
        [SMALL, LARGE, square(1.0), replace(SMALL, noise_fraction=0.01, ambient_T=(2e-5, 0.0, 4e-5))],
        ids=["3 cm", "30 m", "square", "noise that grows with the field"],
    )
    def test_bound_is_the_inverse_information_of_finite_differences(self, array):
        position, moment = suitable_dipole(array)
        moment = np.linalg.norm(moment) * np.array([0.6, -0.48, 0.64])
        covariance = LiveFit(array).forecast(position, moment).covariance
        expected = bound_with_unknown_common_field(array, position, moment)
        scale = np.sqrt(np.diagonal(expected))
        np.testing.assert_allclose(covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6)

    @pytest.mark.parametrize("array", [SMALL, LARGE])
    def test_range_interval_is_nearly_that_of_the_profile(self, array):
        position, moment = suitable_dipole(array)
        live = LiveFit(array)
        forecast = live.forecast(position, moment)
        (profile,) = live.fix(forecast.readings_T).solutions[0].range_interval_m
        assert forecast.range_observable
        # The width is that of a Gaussian: third order terms of a well known range are below a twentieth of it.
        width = profile[1] - profile[0]
        np.testing.assert_allclose(forecast.range_interval_m, profile, atol=0.05 * width)

    def test_range_opens_with_the_distance_and_the_words_follow(self):
        position, moment = suitable_dipole(SMALL)
        live = LiveFit(SMALL)
        near, far = live.forecast(position, moment), live.forecast(4.0 * position, moment)
        assert near.range_observable
        assert not far.range_observable
        assert far.range_interval_m[1] is None
        assert live.fix(far.readings_T).solutions[0].range_observable is False

    @given(st.floats(0.05, 20.0), st.floats(1e-4, 1.0))
    def test_range_interval_holds_the_range(self, distance, relative_sigma):
        offset = distance * np.array([0.6, 0.0, 0.8])
        low, high = gaussian_ranges((relative_sigma * distance) ** 2 * np.eye(3), offset, 1.0)
        assert low < distance < high

    def test_detectable_is_what_a_test_finds_more_often_than_not(self):
        position, moment = suitable_dipole(SMALL)
        live = LiveFit(SMALL)
        strong = live.forecast(position, moment).signal_to_noise
        # Twelve readings less the three components of the common field.
        energy = brentq(lambda energy: ncx2.sf(chi2.isf(FALSE_ALARM, 9), 9, energy) - 0.5, 1.0, 100.0)
        for factor in (0.1, 0.99, 1.01, 10.0, 1e4):
            wanted = factor * np.sqrt(energy)
            forecast = live.forecast(position, moment * wanted / strong)
            assert forecast.signal_to_noise == pytest.approx(wanted, rel=1e-9)
            assert forecast.detectable == (factor > 1.0)

    def test_dipole_on_a_sensor_is_said_and_no_exception(self):
        live = LiveFit(SMALL)
        forecast = live.forecast(SMALL.positions[2], [0.0, 0.0, 1.0])
        assert forecast.reason == "the dipole stands on sensor s3"
        assert forecast.covariance is None
        assert not forecast.detectable
        assert live.fix(forecast.readings_T).solutions == ()

    def test_two_sensors_are_too_few_and_no_moment_is_no_signal(self):
        forecast = LiveFit(axial(1.0)).forecast([2.0, 1.0, 1.0], [0.0, 0.0, 100.0])
        assert forecast.reason == "the array gives 3 independent differences, 6 are needed"
        silent = LiveFit(SMALL).forecast([0.1, 0.0, 0.1], [0.0, 0.0, 0.0])
        assert silent.reason == "a dipole without a moment has no signal"
        assert not silent.detectable

    def test_array_that_no_locator_takes_is_said(self):
        live = LiveFit(square(1.0, "scalar"))
        assert "6 independent differences" in live.fix(np.zeros(4)).reason

    def test_simulated_noise_has_the_array_s_deviation(self):
        live = LiveFit(LARGE)
        forecast = live.forecast(*suitable_dipole(LARGE))
        errors = np.array([live.simulate(forecast.readings_T, seed) - forecast.readings_T for seed in range(200)])
        n = errors.size
        # Outside these bounds in one of ten thousand runs.
        low, high = chi2.ppf([5e-5, 1.0 - 5e-5], n)
        assert low < np.sum((errors / LARGE.channel_noise_T) ** 2) < high
        again = live.simulate(forecast.readings_T, 3)
        np.testing.assert_array_equal(again, live.simulate(forecast.readings_T, 3))


class TestLatest:
    def test_calls_during_a_run_lead_to_one_more_run_which_sees_the_last_state(self):
        state, seen, hold, begun = [0], [], threading.Event(), threading.Event()

        def work() -> None:
            seen.append(state[0])
            begun.set()
            assert hold.wait(WAIT_S)

        latest = CoalescedCall(work)
        first = threading.Thread(target=latest)
        first.start()
        assert begun.wait(WAIT_S)
        for value in range(1, 100):
            state[0] = value
            latest()  # returns at once: the first run is still held
        hold.set()
        first.join()
        assert seen == [0, 99]

    def test_a_failed_run_does_not_block_the_next(self):
        runs = []

        def work() -> None:
            runs.append(None)
            if len(runs) == 1:
                raise ArithmeticError("once")

        latest = CoalescedCall(work)
        with pytest.raises(ArithmeticError):
            latest()
        latest()
        assert len(runs) == 2


class TestTurns:
    @given(st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3))
    def test_direction_comes_back_from_its_turn(self, vector):
        direction = np.array(vector) / np.linalg.norm(vector)
        wxyz = rotation_from_z(direction)
        assert np.linalg.norm(wxyz) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(direction_of(wxyz), direction, atol=2e-6)
        expected = Rotation.from_quat(np.roll(wxyz, -1)).apply([0.0, 0.0, 1.0])
        np.testing.assert_allclose(direction_of(wxyz), expected, atol=1e-12)

    def test_straight_down_and_angles(self):
        np.testing.assert_array_equal(direction_of(rotation_from_z(np.array([0.0, 0.0, -1.0]))), [0.0, 0.0, -1.0])
        np.testing.assert_allclose(angles_of(np.array([0.0, 2.0, 2.0])), (90.0, 45.0))

    def test_steps_suit_the_array(self):
        assert input_step(SMALL.circumradius) == pytest.approx(1e-4)
        assert input_step(LARGE.circumradius) == pytest.approx(0.1)


@pytest.mark.parametrize("array", [SMALL, LARGE], ids=["3 cm", "30 m"])
class TestDipoleEditor:
    def test_everything_follows_a_move(self, server, array):
        editor = DipoleEditor(server, array)
        set_value(editor.noise_checkbox, False)
        radius = array.circumradius
        position = array.centroid + radius * np.array([-1.4, 1.1, 0.7])
        moment = np.linalg.norm(editor.moment_Am2) * np.array([0.0, -0.6, 0.8])
        editor.move_to(position, moment)

        np.testing.assert_allclose(node(server, "/dipole/true").position, position)
        expected = magpylib_field(array.positions, position, moment).ravel()
        np.testing.assert_allclose(editor.forecast.signal_T, expected, rtol=1e-12)
        for nanotesla in 1e9 * expected[:3]:
            assert f"reading {nanotesla:.6g} nT" in editor.readings_panel.content
        # The fit of readings without noise is the dipole.
        fit = node(server, "/dipole/fit 1")
        np.testing.assert_allclose(fit.position, position, atol=1e-5 * radius)
        assert fit.visible
        np.testing.assert_allclose(direction_of(fit.wxyz), moment / np.linalg.norm(moment), atol=1e-4)
        # The surface is the 95 % ellipsoid of the bound.
        offset = np.asarray(node(server, "/dipole/region").vertices) - position
        covariance = bound_with_unknown_common_field(array, position, moment)[:3, :3]
        scale = np.sqrt(np.diagonal(covariance))
        squared = np.einsum(
            "ni,ij,nj->n", offset / scale, np.linalg.inv(covariance / np.outer(scale, scale)), offset / scale
        )
        # The page gets single precision: 1e-7 of the position against the size of the ellipsoid.
        precision = 1e-6 * np.linalg.norm(position) / np.sqrt(np.linalg.eigvalsh(covariance)[0])
        np.testing.assert_allclose(squared, chi2.ppf(0.95, 3), rtol=1e-4 + precision)

    def test_the_first_camera_sees_the_array_and_the_arrow_to_scale(self, server, array):
        editor = DipoleEditor(server, array)
        *sensors, position, tip = editor.extent_m
        np.testing.assert_array_equal(sensors, array.positions)
        np.testing.assert_array_equal(position, editor.position_m)
        assert 0.1 < np.linalg.norm(tip - position) / array.circumradius < 10.0

    def test_the_last_of_many_drags_wins_and_nothing_queues(self, server, array, monkeypatch):
        editor = DipoleEditor(server, array)
        fixes = []
        fix = LiveFit.fix
        monkeypatch.setattr(LiveFit, "fix", lambda self, readings: fixes.append(None) or fix(self, readings))
        start = editor.position_m
        for i in range(60):
            drag(server, editor.control, start * (1.0 + 0.01 * (i + 1)))
        last = start * 1.6
        wait_for(lambda: bool(np.allclose(node(server, "/dipole/true").position, last)))
        wait_for(lambda: not editor._update_fix._is_running and not editor._update_forecast._is_running)
        assert 1 <= len(fixes) <= 60
        np.testing.assert_allclose(editor.position_input.value, last, atol=0.1 * input_step(array.circumradius))
        np.testing.assert_allclose(editor.forecast.signal_T, LiveFit(array).forecast(last, editor.moment_Am2).signal_T)
        n_fixes = len(fixes)
        time.sleep(0.1)
        assert len(fixes) == n_fixes

    def test_a_slow_fit_does_not_hold_the_readings_back(self, server, array, monkeypatch):
        editor = DipoleEditor(server, array)
        hold, begun = threading.Event(), threading.Event()

        def slow(self: LiveFit, readings: np.ndarray) -> Fix:
            begun.set()
            assert hold.wait(WAIT_S)
            return Fix((), "held")

        monkeypatch.setattr(LiveFit, "fix", slow)
        start = editor.position_m
        drag(server, editor.control, 1.1 * start)
        assert begun.wait(WAIT_S)
        for factor in (1.2, 1.3):
            drag(server, editor.control, factor * start)
            wait_for(lambda factor=factor: bool(np.allclose(node(server, "/dipole/true").position, factor * start)))
        hold.set()
        wait_for(lambda: "held" in editor.fit_panel.content)

    def test_turning_the_control_and_the_inputs_turn_the_moment(self, server, array):
        editor = DipoleEditor(server, array)
        strength = np.linalg.norm(editor.moment_Am2)
        drag(server, editor.control, editor.position_m, wxyz=rotation_from_z(np.array([0.0, 1.0, 0.0])))
        wait_for(lambda: editor.azimuth_slider.value == 90.0 and editor.elevation_slider.value == 0.0)
        np.testing.assert_allclose(editor.moment_Am2, [0.0, strength, 0.0], atol=1e-9 * strength)
        set_value(editor.azimuth_slider, 180.0)
        set_value(editor.elevation_slider, 30.0)
        expected = strength * np.array([-np.sqrt(0.75), 0.0, 0.5])
        np.testing.assert_allclose(editor.moment_Am2, expected, atol=1e-9 * strength)
        # A run that drew what was there before may still be under way; the last one draws the last state.
        arrow = node(server, "/dipole/true")
        wait_for(lambda: np.allclose(direction_of(arrow.wxyz), expected / strength, rtol=0.0, atol=1e-9))
        set_value(editor.moment_input, 2.0 * float(strength))
        np.testing.assert_allclose(np.linalg.norm(editor.moment_Am2), 2.0 * strength, rtol=1e-3)
        set_value(editor.decades_slider, editor.decades_slider.min)
        np.testing.assert_allclose(np.linalg.norm(editor.moment_Am2), 10.0**editor.decades_slider.min, rtol=1e-9)

    def test_a_typed_position_moves_the_control(self, server, array):
        editor = DipoleEditor(server, array)
        place = tuple(np.round(array.centroid + 2.0 * array.circumradius, 3).tolist())
        set_value(editor.position_input, place)
        np.testing.assert_allclose(editor.control.position, place)
        np.testing.assert_allclose(node(server, "/dipole/true").position, place)
        set_value(editor.back_button, True)
        np.testing.assert_allclose(editor.position_m, suitable_dipole(array)[0])

    def test_weak_far_and_impossible_dipoles_are_said_and_left_again(self, server, array):
        editor = DipoleEditor(server, array)
        position, moment = editor.position_m, editor.moment_Am2
        assert "range observable" in editor.bound_panel.content
        reach = np.ptp(np.asarray(node(server, "/dipole/region").vertices), axis=0).max()

        editor.move_to(position * 3.0, moment)
        assert "<b>not observable</b>" in editor.bound_panel.content
        # The long region reaches farther than the source is away from the array.
        assert np.ptp(np.asarray(node(server, "/dipole/region").vertices), axis=0).max() > 20.0 * reach

        editor.move_to(position * 40.0, moment)
        assert "too weak to be detected" in editor.bound_panel.content
        assert "fit of noise" in editor.fit_panel.content

        editor.move_to(array.positions[0], moment)
        assert "stands on sensor s1" in editor.bound_panel.content
        assert "no solution" in editor.fit_panel.content
        assert not node(server, "/dipole/fit 1").visible
        assert not node(server, "/dipole/region").visible

        editor.move_to(position, moment)
        assert node(server, "/dipole/fit 1").visible
        assert node(server, "/dipole/region").visible
        assert "χ²/dof" in editor.fit_panel.content

    def test_no_moment_is_no_dipole(self, server, array):
        editor = DipoleEditor(server, array)
        set_value(editor.moment_input, 0.0)
        assert not node(server, "/dipole/true").visible
        assert "a dipole without a moment has no signal" in editor.fit_panel.content
        set_value(editor.decades_slider, editor.decades_slider.max)
        assert node(server, "/dipole/true").visible

    def test_noise_has_a_seed_and_may_be_left_out(self, server, array):
        editor = DipoleEditor(server, array)
        first = editor.fix.best.position_m
        set_value(editor.draw_button, True)
        assert editor.seed_input.value == 1
        second = editor.fix.best.position_m
        assert np.linalg.norm(second - first) > 0.0
        set_value(editor.seed_input, 0)
        np.testing.assert_array_equal(editor.fix.best.position_m, first)
        set_value(editor.noise_checkbox, False)
        np.testing.assert_allclose(editor.fix.best.position_m, editor.position_m, rtol=1e-5)

    def test_a_changed_array_reads_the_same_dipole(self, server, array):
        editor = DipoleEditor(server, array)
        other = move_sensor(array, array.ids[0], array.positions[0] * 1.5)
        editor.set_array(other)
        expected = magpylib_field(other.positions, editor.position_m, editor.moment_Am2).ravel()
        np.testing.assert_allclose(editor.forecast.signal_T, expected, rtol=1e-12)


def move(editor: ArrayEditor, sensor_id: str, position_m: ArrayLike) -> None:
    """Choose a sensor, and drag it."""
    set_value(editor.sensor_dropdown, sensor_id)
    editor.control.position = np.asarray(position_m, dtype=np.float64)
    editor._update()


class TestArrayEditor:
    def test_a_dragged_sensor_changes_the_array_and_the_bound(self, server):
        dipole = DipoleEditor(server, SMALL)
        seen: list[SensorArray] = []
        editor = ArrayEditor(server, SMALL, on_change=[seen.append, dipole.set_array])
        assert not editor.control.visible
        set_value(editor.drag_checkbox, True)
        assert editor.control.visible
        set_value(editor.sensor_dropdown, "s3")
        np.testing.assert_array_equal(editor.control.position, SMALL.positions[2])
        assert not seen
        before = dipole.forecast.covariance
        place = np.array([0.05, 0.01, 0.02])
        drag(server, editor.control, place)
        wait_for(lambda: bool(seen) and dipole.array is seen[-1])
        expected = SMALL.positions.copy()
        expected[2] = place
        np.testing.assert_allclose(editor.array.positions, expected, atol=1e-9)
        wait_for(lambda: dipole.forecast.covariance is not before and not dipole._update_forecast._is_running)
        bound = bound_with_unknown_common_field(editor.array, dipole.position_m, dipole.moment_Am2)
        np.testing.assert_allclose(np.diagonal(dipole.forecast.covariance), np.diagonal(bound), rtol=1e-6)
        np.testing.assert_allclose(editor.position_input.value, place, atol=1e-9)
        set_value(editor.back_button, True)
        assert editor.array == SMALL
        assert seen[-1] == SMALL
        np.testing.assert_array_equal(editor.control.position, SMALL.positions[2])

    def test_two_sensors_in_one_place_are_one_sentence_and_no_array(self, server):
        seen: list[SensorArray] = []
        editor = ArrayEditor(server, SMALL, on_change=[seen.append])
        move(editor, "s2", SMALL.positions[0])
        sentence = "Not moved: sensors s1 and s2 would stand in the same place."
        assert editor.move_panel.content == panel_html([sentence], warning=True)
        assert editor.array == SMALL
        assert not seen
        move(editor, "s2", [0.0, 0.0, 0.1])
        assert editor.move_panel.content == ""
        np.testing.assert_allclose(editor.array.positions[1], [0.0, 0.0, 0.1], atol=1e-9)

    def test_typed_positions_count(self, server):
        editor = ArrayEditor(server, SMALL)
        set_value(editor.position_input, (0.02, 0.0, 0.0))
        np.testing.assert_allclose(editor.array.positions[0], [0.02, 0.0, 0.0], atol=1e-12)

    def test_saved_array_is_read_back(self, server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.chdir(tmp_path)
        array = replace(SMALL, name="edited", ambient_T=(1e-5, 0.0, 4e-5))
        editor = ArrayEditor(server, array)
        set_value(editor.path_input, str(tmp_path / "a.toml"))
        move(editor, "s4", [0.001, 0.002, 0.05])
        set_value(editor.save_button, True)
        assert read_array(tmp_path / "a.toml") == editor.array
        assert "saved as" in editor.save_panel.content
        assert not editor.overwrite_button.visible

    def test_an_existing_file_is_replaced_after_a_confirmation_only(self, server, tmp_path: Path):
        path = tmp_path / "a.toml"
        write_array(path, LARGE)
        editor = ArrayEditor(server, SMALL, file=path)
        set_value(editor.path_input, str(path))
        set_value(editor.save_button, True)
        assert read_array(path) == LARGE
        assert editor.overwrite_button.visible
        assert "exists already" in editor.save_panel.content
        # Another path takes the question away; it has to be asked anew.
        set_value(editor.path_input, str(tmp_path / "b.toml"))
        assert not editor.overwrite_button.visible
        set_value(editor.path_input, str(path))
        set_value(editor.save_button, True)
        set_value(editor.overwrite_button, True)
        assert read_array(path) == SMALL
        assert not editor.overwrite_button.visible

    def test_paths_that_cannot_be_written_are_one_sentence(self, server, tmp_path: Path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        editor = ArrayEditor(server, SMALL)
        for path, words in {
            tmp_path / "a.txt": "ends in .toml",
            tmp_path / "none" / "a.toml": "there is no folder",
            tmp_path: "ends in .toml",
        }.items():
            set_value(editor.path_input, str(path))
            set_value(editor.save_button, True)
            assert words in editor.save_panel.content
        (tmp_path / "folder.toml").mkdir()
        assert "is a folder" in path_fault(tmp_path / "folder.toml")
        assert [path.name for path in tmp_path.iterdir()] == ["folder.toml"]

    def test_only_sensors_of_one_kind_exclude_each_other(self):
        scalar = replace(SMALL.sensors[0], id="m1", kind="scalar", position_m=(0.5, 0.0, 0.0), calibration=None)
        array = replace(SMALL, sensors=(*SMALL.sensors, scalar))
        at_one_place = move_sensor(array, "m1", SMALL.positions[0])
        np.testing.assert_array_equal(at_one_place.positions[4], SMALL.positions[0])
        assert plain_locator(SMALL).fit(LiveFit(SMALL).forecast(*suitable_dipole(SMALL)).readings_T).solutions
