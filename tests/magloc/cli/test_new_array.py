"""``magloc new-array``: what it writes is what the functions of arrays make."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest

import arrays
from tests.command_line import Run, assert_refused


def test_a_shape(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "a.toml"
    assert run("new-array", out, "--shape", "cube", "--size-m", "1.5", "--noise-nT", "0.3").status == 0
    assert arrays.read_array(out) == arrays.cube(1.5, "vector", 3e-10)


def test_a_board_of_a_sensor(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "a.toml"
    done = run("new-array", out, "--shape", "grid", "--grid", "3", "2", "--size-m", "0.05", "--sensor", "rm3100")
    assert arrays.read_array(out) == arrays.grid(3, 2, 0.05, "vector", 15e-9)
    assert arrays.SENSOR_PRESETS["rm3100"].source in done.err
    assert arrays.SENSOR_PRESETS["rm3100"].source in out.read_text(encoding="utf-8")


@pytest.mark.parametrize(("rate_Hz", "noise_T"), [(2.0, 1.5e-11), (8.0, 3e-11)])
def test_noise_density_and_rate(run: Run, tmp_path: Path, rate_Hz: float, noise_T: float) -> None:
    out = tmp_path / "a.toml"
    run("new-array", out, "--shape", "square", "--size-m", "2", "--sensor", "overhauser", "--rate-Hz", str(rate_Hz))
    assert arrays.read_array(out) == arrays.square(2.0, "scalar", noise_T)


@pytest.mark.parametrize("name", arrays.SENSOR_PRESETS)
def test_every_preset_names_its_source(run: Run, tmp_path: Path, name: str) -> None:
    preset = arrays.SENSOR_PRESETS[name]
    given = ("--noise-nT", "100000") if preset.noise_of_reading_nT(10.0) is None else ()
    options = ("--shape", "tetrahedron", "--size-m", "0.5", "--sensor", name)
    if given:
        assert_refused(run("new-array", tmp_path / "a.toml", *options), "--noise-nT", "that of your data sheet")
    assert run("new-array", tmp_path / "a.toml", *options, *given).status == 0
    sensor = arrays.read_array(tmp_path / "a.toml").sensors[0]
    assert sensor.kind == preset.kind
    assert (sensor.saturation_T is None) == (preset.saturation_nT is None)
    assert len(preset.source) > 30


def test_questions(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stdin", Terminal("grid\n3\n2\n0.05\n\nscalar\n0.2\n"))
    done = run("new-array", tmp_path / "a.toml")
    assert done.status == 0
    assert done.err.startswith("Shape (tetrahedron, ")
    assert "Distance of neighbours [m]" in done.err
    assert arrays.read_array(tmp_path / "a.toml") == arrays.grid(3, 2, 0.05, "scalar", 2e-10)


@pytest.mark.parametrize(
    ("options", "fragments"),
    [
        ((), ("--shape", "found nothing", "tetrahedron")),
        (("--shape", "ball", "--size-m", "1"), ("--shape", "'ball'")),
        (("--shape", "cube"), ("--size-m", "found nothing")),
        (("--shape", "cube", "--size-m", "-1"), ("--size-m", "-1")),
        (("--shape", "cube", "--size-m", "1"), ("--noise-nT", "found nothing")),
        (("--shape", "cube", "--size-m", "1", "--noise-nT", "0"), ("--noise-nT", "positive")),
        (("--shape", "grid", "--size-m", "1", "--noise-nT", "1"), ("--grid", "NX NY")),
        (("--shape", "grid", "--size-m", "1", "--noise-nT", "1", "--grid", "1", "1"), ("--grid", "at least 2")),
        (("--shape", "cube", "--size-m", "1", "--noise-nT", "1", "--sensor", "x"), ("--sensor", "rm3100")),
        (("--shape", "cube", "--size-m", "1", "--sensor", "opm", "--kind", "vector"), ("--kind", "scalar sensor")),
        (("--shape", "cube", "--size-m", "1", "--noise-nT", "1", "--rate-Hz", "0"), ("--rate-Hz", "positive")),
    ],
)
def test_refused(run: Run, tmp_path: Path, options: tuple[str, ...], fragments: tuple[str, ...]) -> None:
    assert_refused(run("new-array", tmp_path / "a.toml", *options), *fragments)
    assert not (tmp_path / "a.toml").exists()
