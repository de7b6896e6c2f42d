"""First steps: ``demo``, and ``warm-up`` of both command lines."""

from __future__ import annotations

import shlex
from importlib.util import find_spec
from pathlib import Path

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
        assert "321 of 321 rows answered" in done.out

    @pytest.mark.slow
    def test_its_commands_do_what_it_does(self, run: Run, tmp_path: Path) -> None:
        done = run("demo", tmp_path / "a demo")
        call = next(call for call in typed(done.out, "magloc") if call[0] == "locate")
        again = run(*call)
        assert again.status == 0
        lines = done.out.splitlines()
        shown = next(i for i, line in enumerate(lines) if line.startswith("$ magloc locate"))
        assert again.out.splitlines()[:4] == lines[shown + 1 : shown + 5]

    @pytest.mark.slow
    def test_without_the_viewer(self, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("magloc.cli.first_steps.demo.find_spec", lambda _: None)
        done = run("demo", tmp_path / "demo")
        assert [call[0] for call in typed(done.out, "magloc")] == ["simulate", "locate", "track"]
        assert "magloc[view]" in done.err

    def test_a_file_in_the_way(self, run: Run, tmp_path: Path) -> None:
        (tmp_path / "demo").write_text("")
        assert_refused(run("demo", tmp_path / "demo"), "OUT", "expected a folder")


@pytest.mark.parametrize("program", ["magloc", "adcs"])
def test_warm_up_has_nothing_to_do(program: str, request: pytest.FixtureRequest) -> None:
    run: Run = request.getfixturevalue("run" if program == "magloc" else program)
    done = run("warm-up")
    assert (done.status, done.out) == (0, "")
    assert done.err == f"{program}: warm-up has nothing to do: the package is compiled when it is installed\n"
