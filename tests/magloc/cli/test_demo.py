"""First steps: ``demo``, and ``warm-up`` of both command lines."""

from __future__ import annotations

import json
import shlex
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import Run, assert_refused


def typed(out: str, program: str) -> list[list[str]]:
    """The commands that a demo has shown."""
    return [shlex.split(line)[2:] for line in out.splitlines() if line.startswith(f"$ {program} ")]


class TestDemo:
    def test_shows_four_commands_and_draws(self, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        done = run("demo")
        assert done.status == 0, done.err
        scene = find_spec("viser") is not None
        assert [call[0] for call in typed(done.out, "magloc")] == ["simulate", "locate", "track", "view"][: 3 + scene]
        assert (tmp_path / "magloc-demo" / "track" / "track.png").stat().st_size > 20_000
        assert (tmp_path / "magloc-demo" / "target.html").exists() == scene
        assert "321 rows in 160 s" in done.out
        assert "Next, with sensors and a log of your own" in done.out
        assert len(done.out.splitlines()) <= 15

    @pytest.mark.slow
    def test_its_commands_do_what_it_does(self, run: Run, tmp_path: Path) -> None:
        """The story's numbers are those of the commands that are shown."""
        done = run("demo", tmp_path / "a demo")
        fixes, track = (
            json.loads(run(*next(call for call in typed(done.out, "magloc") if call[0] == name)).out)
            for name in ("locate", "track")
        )
        truth = np.genfromtxt(tmp_path / "a demo" / "target-truth.csv", delimiter=",", names=True)
        expected = np.stack([truth[name] for name in ("x_m", "y_m", "z_m")], axis=1)
        places = [row["solutions"][0] for row in fixes["results"]], track["results"]
        alone, joined = (
            np.sqrt(np.mean(np.sum((np.array([row["position_m"] for row in rows]) - expected) ** 2, axis=1)))
            for rows in places
        )
        assert f"is {alone:.2f} m off (rms); `track` joins the rows, {joined:.2f} m." in done.out

    @pytest.mark.slow
    def test_without_the_viewer(self, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("magloc.cli.first_steps.demo.find_spec", lambda _: None)
        done = run("demo", tmp_path / "demo")
        assert [call[0] for call in typed(done.out, "magloc")] == ["simulate", "locate", "track"]
        assert "magloc[view]" in done.out

    def test_a_file_in_the_way(self, run: Run, tmp_path: Path) -> None:
        (tmp_path / "demo").write_text("")
        assert_refused(run("demo", tmp_path / "demo"), "OUT", "expected a folder")


@pytest.mark.parametrize("program", ["magloc", "adcs"])
def test_warm_up_has_nothing_to_do(program: str, request: pytest.FixtureRequest) -> None:
    run: Run = request.getfixturevalue("run" if program == "magloc" else program)
    done = run("warm-up")
    assert (done.status, done.out) == (0, "")
    assert done.err == f"{program}: warm-up has nothing to do: the package is compiled when it is installed\n"
