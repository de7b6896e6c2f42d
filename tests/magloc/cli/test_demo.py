"""First steps: ``demo`` of both command lines, ``warm-up``, and what is said while something compiles."""

from __future__ import annotations

import logging
import shlex
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from magloc import compilation
from magloc.cli import app, framework
from magloc.plots import style
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


class TestWarmUp:
    @pytest.mark.slow
    def test_runs_every_command_that_compiles(self, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
        called: list[str] = []
        for name in ("convergence", "sources", "bound_slices", "bound_sphere", "bound_reach"):  # nothing of it compiles
            monkeypatch.setattr(f"magloc.plots.{name}", lambda *_: style.new_figure(1.0))
        whole = framework.call
        monkeypatch.setattr(framework, "call", lambda app, tokens: called.append(tokens[0]) or whole(app, tokens))
        done = run("warm-up")
        assert done.status == 0, done.err
        assert done.out == ""
        assert set(called) == {"warm-up", "locate", "simulate", "track", "map", "bounds"}
        assert "compiled" in done.err


class TestCompiling:
    @pytest.mark.parametrize("watched", [True, False])
    def test_is_said_once_where_somebody_watches(
        self, watched: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        listener = compilation._Announcement()
        monkeypatch.setattr(sys.stderr, "isatty", lambda: watched)
        with framework._notes_of_the_library(app.app.name[0]):
            for happens in (listener.on_start, listener.on_start, listener.on_end, listener.on_end):
                happens(None)  # type: ignore[arg-type]  # what is compiled does not matter
        assert capsys.readouterr().err.count(compilation.COMPILING) == watched

    def test_numba_says_when_it_compiles(self, caplog: pytest.LogCaptureFixture) -> None:
        from numba import njit
        from numba.core import event

        listener = compilation._Announcement()
        with caplog.at_level(logging.INFO, "magloc"), event.install_listener("numba:compile", listener):
            assert njit(lambda x: x + 1)(1) == 2
        assert listener.said

    @pytest.mark.parametrize("collects", [True, False])
    def test_garbage_waits_until_a_kernel_and_those_that_it_calls_are_compiled(
        self, collects: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        listener, state = compilation._GarbageWaits(), [collects]
        monkeypatch.setattr(compilation.gc, "isenabled", lambda: state[-1])
        monkeypatch.setattr(compilation.gc, "disable", lambda: state.append(False))
        monkeypatch.setattr(compilation.gc, "enable", lambda: state.append(True))
        for happens in (listener.on_start, listener.on_start, listener.on_end):
            happens(None)  # type: ignore[arg-type]
            assert not state[-1]
        listener.on_end(None)  # type: ignore[arg-type]
        assert state[-1] == collects
