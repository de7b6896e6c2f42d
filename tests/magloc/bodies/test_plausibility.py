"""Lengths in another unit than metres are named, by all that take a body and an array."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from arrays.array import SensorArray
from magloc.bodies.body import MagnetBody, PoseLimits
from magloc.bodies.filter import BodyTracker
from magloc.bodies.locator import BodyLocator
from magloc.bodies.plausibility import check_lengths, check_reach, warn_of_no_check
from magloc.bounds.bodies import body_bounds
from magloc.fields.shapes import Shape
from tests.magloc.bodies.devices import hall_ring, knob

PER_M = 1e3


def balls(diameter_m: float) -> MagnetBody:
    return replace(knob(), magnets=[replace(m, shape=Shape("sphere", (diameter_m,))) for m in knob().magnets])


def range_in_mm() -> MagnetBody:
    limits = knob().limits
    low, high = (tuple(PER_M * np.array(edge)) for edge in (limits.low_m, limits.high_m))
    return replace(knob(), limits=PoseLimits(low, high, limits.angle_rad))


def magnets_in_mm() -> MagnetBody:
    return replace(knob(), magnets=[replace(m, position_m=PER_M * np.array(m.position_m)) for m in knob().magnets])


def sensors_in_mm() -> SensorArray:
    array = hall_ring()
    return replace(array, sensors=tuple(replace(s, position_m=PER_M * np.array(s.position_m)) for s in array.sensors))


def moments_in_tesla() -> MagnetBody:
    """The remanence in place of the moment."""
    return replace(knob(), magnets=[replace(m, moment_Am2=26.0 * np.array(m.moment_Am2)) for m in knob().magnets])


@pytest.mark.parametrize(
    ("array", "body", "named"),
    [
        (hall_ring(), balls(5.0), "m1 and m2 are 0.0104 m apart, with size_m 5 (millimetres are 0.005)"),
        (hall_ring(), moments_in_tesla(), "is moment_Am2 a remanence in T?"),
        (hall_ring(), range_in_mm(), "position_m of the table range looks like millimetres"),
        (hall_ring(), magnets_in_mm(), "position_m of the magnets looks like millimetres"),
        (sensors_in_mm(), knob(), "position_m of the sensors looks like millimetres"),
    ],
)
@pytest.mark.parametrize("use", [BodyLocator, BodyTracker, body_bounds, check_lengths])
def test_another_unit_is_named(
    use: Callable[[SensorArray, MagnetBody], object], array: SensorArray, body: MagnetBody, named: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(named)):
        use(array, body)


def test_a_body_that_holds_a_sensor_in_every_pose_is_refused() -> None:
    limits = PoseLimits((-1e-4, -1e-4, 0.0), (1e-4, 1e-4, 1e-4), 0.01)
    body = replace(balls(0.006), limits=limits)
    sensors = zip(body.magnets, hall_ring().positions, strict=True)
    places = [replace(magnet, position_m=tuple(place)) for magnet, place in sensors]
    with pytest.raises(ValueError, match="all sensors outside its magnets"):
        check_reach(hall_ring(), replace(body, magnets=places))


def test_true_lengths_are_accepted() -> None:
    for body in (knob(), replace(knob(), limits=PoseLimits()), balls(0.005)):
        check_lengths(hall_ring(), body)


@pytest.mark.parametrize(("sensors", "common_T", "doubtful"), [(3, 50e-6, True), (3, 1e-6, False), (4, 50e-6, False)])
def test_readings_that_leave_no_check_are_a_warning(
    sensors: int, common_T: float, doubtful: bool, caplog: pytest.LogCaptureFixture
) -> None:
    warn_of_no_check(hall_ring(sensors, common_field_T=common_T), 6)
    assert ("9 readings leave no check of a pose" in caplog.text) is doubtful
