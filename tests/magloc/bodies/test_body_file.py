"""Body files: what is read, what is written, and bad input in one sentence."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arrays.io.errors import InputError
from magloc.bodies.body import MagnetBody, PoseLimits
from magloc.bodies.body_file import body_toml, read_body, write_body

KNOB = """
name = "knob"
temperature_sigma_K = 10.0

[[magnet]]
id = "m1"
position_m = [0.006, 0.0, 0.0]
moment_Am2 = 0.05
direction = [0, 3, 4]
moment_sigma_Am2 = 0.002
shape = "cylinder"
size_m = [0.004, 0.005]

[[magnet]]
id = "m2"
position_m = [-0.003, 0.005, 0.0]
moment_Am2 = [0.0, 0.0, 0.05]
position_sigma_m = 0.0001
direction_sigma_deg = 1.0

[range]
position_m = [[-0.003, 0.003], [-0.003, 0.003], [0.010, 0.014]]
angle_deg = 20
"""


def body_of(text: str, folder: Path) -> MagnetBody:
    (folder / "body.toml").write_text(text, encoding="utf-8")
    return read_body(folder / "body.toml")


def test_file_has_the_body(tmp_path: Path) -> None:
    body = body_of(KNOB, tmp_path)
    assert body.ids == ("m1", "m2")
    np.testing.assert_allclose(body.moments_Am2[0], [0.0, 0.03, 0.04])
    np.testing.assert_allclose(body.magnets[0].R_body_from_shape[:, 2], [0.0, 0.6, 0.8])
    np.testing.assert_allclose(body.limits.angle_rad, np.radians(20.0))
    assert body.limits.low_m == (-0.003, -0.003, 0.010)
    np.testing.assert_allclose(body.moment_root, [[0.04, 0.011], [0.0, 0.011]])


def test_a_body_survives_writing_and_reading(tmp_path: Path) -> None:
    body = body_of(KNOB, tmp_path)
    write_body(tmp_path / "again.toml", body)
    again = read_body(tmp_path / "again.toml")
    assert body_toml(again) == body_toml(body)
    np.testing.assert_allclose(again.moments_Am2, body.moments_Am2, rtol=1e-15)


def test_limits_on_one_side_survive_writing(tmp_path: Path) -> None:
    (tmp_path / "knob.toml").write_text(KNOB, encoding="utf-8")
    above = PoseLimits((-math.inf, -math.inf, 0.01), (math.inf, math.inf, math.inf))
    write_body(tmp_path / "again.toml", replace(read_body(tmp_path / "knob.toml"), limits=above))
    assert read_body(tmp_path / "again.toml").limits == above


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('[[magnet]]\nid = "m2"', '[other]\nid = "m2"', "unknown key"),
        ('id = "m2"', 'id = "m1"', "different ids"),
        ("position_m = [-0.003, 0.005, 0.0]", "position_m = [0.006, 0.0, 0.0]", "act as a single one"),
        ("position_m = [-0.003, 0.005, 0.0]", "position_mm = [-3, 5, 0]", "nearest is position_m"),
        ("position_m = [-0.003, 0.005, 0.0]", "position_m = [-3000, 5000, 0.0]", "expected metres"),
        ("moment_Am2 = [0.0, 0.0, 0.05]", "moment_Am2 = [0.0, 0.0, 0.0]", "different from zero"),
        ("moment_Am2 = [0.0, 0.0, 0.05]", "moment_Am2 = [0.0, 0.05]", "expected"),
        ("moment_Am2 = [0.0, 0.0, 0.05]", "moment_Am2 = 0.05", "without a direction"),
        ("direction = [0, 3, 4]", "direction = [0, 0, 0]", "expected a vector of any length"),
        ("moment_Am2 = 0.05", "moment_Am2 = 50.0", "remanence"),
        ("size_m = [0.004, 0.005]", "size_m = [0.004]", "diameter, height"),
        ('shape = "cylinder"', 'shape = "cone"', "one of cuboid"),
        ('shape = "cylinder"\n', "", "without shape"),
        ("angle_deg = 20", "angle_deg = 0", "above 0"),
        ("[-0.003, 0.003], [0.010", "[0.003, -0.003], [0.010", "lower limit below"),
        ("temperature_sigma_K = 10.0", "temperature_sigma_C = 10.0", "nearest is temperature_sigma_K"),
    ],
)
def test_bad_input_is_one_sentence_with_its_place(old: str, new: str, sentence: str, tmp_path: Path) -> None:
    assert old in KNOB
    with pytest.raises(InputError, match=sentence) as caught:
        body_of(KNOB.replace(old, new), tmp_path)
    assert "body.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_one_magnet_is_no_body(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"at least 2; instead received 1"):
        body_of(KNOB.split('[[magnet]]\nid = "m2"')[0], tmp_path)
    with pytest.raises(InputError, match=r"no \[\[magnet\]\]"):
        body_of('name = "knob"', tmp_path)
