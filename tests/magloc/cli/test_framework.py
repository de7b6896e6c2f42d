"""What starting a command costs, in modules and not in seconds, and what it says where an extra is missing."""

from __future__ import annotations

import contextlib
import json
import logging
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

import cyclopts
import numpy as np
import pytest
from cyclopts import App

from adcs.mockup.vision.sky import AmbiguousSkyWarning
from arrays import read_array
from arrays.io.errors import InputError, naming
from magloc import core
from magloc.cli import framework
from magloc.cli.framework import print_json_list
from tests.command_line import Outcome, Run, assert_refused
from tests.waiting import WAIT_S

COMMANDS = (
    "calibrate",
    "locate",
    "map",
    "track",
    "live",
    "signature",
    "bounds",
    "design",
    "new-array",
    "export-config",
    "columns",
    "qc",
    "survey",
    "compensate",
    "demo",
    "simulate",
    "view",
    "warm-up",
)
HEAVY = {"numpy", "scipy", "matplotlib", "filterpy", "pandas", "xarray", "zarr", "trimesh", "viser", "msgspec"}

MOST = 3


def modules_after(program: str) -> set[str]:
    """Top-level modules that a program has loaded in a process of its own."""
    code = f"{program}\nimport sys\nprint(*{{name.split('.')[0] for name in sys.modules}}, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    return set(done.stderr.splitlines()[-1].split())


def modules_of(command_line: str, *calls: Sequence[str | Path]) -> set[str]:
    """Top-level modules that calls of a command line have loaded, one after the other."""
    texts = [[str(argument) for argument in call] for call in calls]
    return modules_after(f"from {command_line}.cli.app import main\nfor call in {texts}: main(call)")


def without(extras: Sequence[str], *arguments: str | Path) -> Outcome:
    """Run ``magloc`` where the modules of some extras are not installed."""
    hidden = [module for extra in extras for module in EXTRAS[extra]]
    code = f"import sys\nsys.modules.update(dict.fromkeys({hidden}))\nfrom magloc.cli.app import main\nsys.exit(main())"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    return Outcome(done.returncode, done.stdout, done.stderr)


EXTRAS = {
    "view": ("viser", "trimesh", "skimage", "websockets"),
    "maps": ("zarr", "netCDF4"),
    "geo": ("ppigrf", "wmm", "pymap3d"),
}


class TestLoaded:
    @pytest.mark.parametrize("package", ["arrays", "magloc", "adcs", "sims"])
    def test_by_an_import(self, package: str) -> None:
        assert not modules_after(f"import {package}") & HEAVY

    def test_a_heavy_module_is_seen(self) -> None:
        assert "numpy" in modules_after("import magloc.readings")

    @pytest.mark.parametrize("command_line", ["magloc", "adcs"])
    @pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["wrong"], ["--wrong"]])
    def test_by_a_command_line(self, command_line: str, arguments: list[str]) -> None:
        assert not modules_of(command_line, arguments) & HEAVY

    def test_by_the_help_and_the_refusals_of_commands(self) -> None:
        calls = [[command, option] for command in COMMANDS for option in ("--help", "--wrong")]
        assert not modules_of("magloc", *calls) & HEAVY

    def test_by_the_help_of_commands_of_adcs(self) -> None:
        runs = [["run", "complementary"], ["run", "ellipsoid"], ["run", "mockup"]]
        calls = [[*command, "--help"] for command in (["run"], *runs, ["compare"], ["tables"], ["estimate"], ["stars"])]
        assert not modules_of("adcs", *calls) & (HEAVY - {"numpy", "msgspec"})

    @pytest.mark.slow
    def test_by_fixes(self, recording: tuple[Path, Path]) -> None:
        readings, array = recording
        loaded = modules_of("magloc", ["locate", readings, "--array", array])
        assert "scipy" in loaded
        assert not loaded & {"trimesh", "viser", "matplotlib", "zarr", "xarray", "filterpy", "pandas"}


class TestWrongCommand:
    def test_names_the_nearest(self, run: Run) -> None:
        assert_refused(run("calibrat"), 'Unknown command "calibrat". Did you mean "calibrate"? ', "locate, map")

    @pytest.mark.parametrize(
        ("line", "what"), [("locate x.csv", "--array is missing"), ("locate x.csv --array", "--array requires")]
    )
    def test_tells_a_missing_option_from_one_without_its_value(self, run: Run, line: str, what: str) -> None:
        assert_refused(run(*line.split()), what)

    def test_names_all(self, run: Run) -> None:
        assert_refused(run("zzz"), f'Unknown command "zzz". Available commands: {", ".join(COMMANDS)}.')


class TestSentence:
    def test_without_what_a_terminal_obeys(self, run: Run) -> None:
        assert_refused(run("view", "\x1b[31m"), r"magloc: \x1b[31m does not exist")

    def test_without_a_word_that_does_not_end(self, run: Run) -> None:
        outcome = run("view", "9" * 240)
        assert_refused(outcome, "99999…99999")
        assert len(outcome.err) < 240


class TestMissingExtra:
    def test_view(self, recording: tuple[Path, Path]) -> None:
        assert_refused(
            without(["view"], "view", recording[1]), 'the viewer needs the extra "view": pip install "magloc['
        )

    @pytest.mark.slow
    def test_maps(self, tmp_path: Path) -> None:
        outcome = without(["maps"], "map", "--grid", "2", "--out", tmp_path / "map", "--quiet")
        assert_refused(outcome, 'a stored map needs the extra "maps": pip install "magloc[maps]".')

    def test_geo(self, recording: tuple[Path, Path]) -> None:
        readings, array = recording
        place = ("--place", "50", "10", "0", "--date", "2026-11-21")
        outcome = without(["geo"], "locate", readings, "--array", array, *place)
        assert_refused(outcome, '--place: a place on the Earth needs the extra "geo": pip install "magloc[geo]".')

    def test_surface(self, tmp_path: Path) -> None:
        outcome = without(["view"], "design", "hull", "--out", tmp_path / "array.toml")
        assert_refused(outcome, 'the surface of a mesh needs the extra "view": pip install "magloc[view]".')

    def test_mesh(self) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(sys.modules, "trimesh", None)
            patch.delitem(sys.modules, "arrays.meshes", raising=False)
            with pytest.raises(InputError, match='the mesh of an array needs the extra "view"'):
                import_module("arrays.meshes")

    @pytest.mark.slow
    def test_a_fix_needs_none(self, recording: tuple[Path, Path]) -> None:
        readings, array = recording
        assert without(list(EXTRAS), "locate", readings, "--array", array, "--quiet").status == 0


class TestWhatNobodyExpected:
    """A command line in which one command does what it is told to."""

    @staticmethod
    def outcome(command: Callable[[], object], capsys: pytest.CaptureFixture[str]) -> Outcome:
        app = App(name="magloc")
        app.command(command, name="go")
        with warnings.catch_warnings():
            warnings.simplefilter("default")  # as a user has it
            return Outcome(framework.run(app, ["go"]), *capsys.readouterr())

    def test_error_of_another_library_is_no_fault_of_a_file(self, capsys: pytest.CaptureFixture[str]) -> None:
        def go() -> None:
            with naming("log.csv"):
                np.linalg.inv(np.zeros((2, 2)))

        outcome = self.outcome(go, capsys)
        assert outcome.status == 1
        assert outcome.err.startswith("magloc: internal error in ")
        assert "(LinAlgError: Singular matrix)" in outcome.err
        assert "please report" in outcome.err
        assert "log.csv" not in outcome.err
        assert len(outcome.err.splitlines()) == 1

    def test_want_of_memory_has_a_cure(self, capsys: pytest.CaptureFixture[str]) -> None:
        outcome = self.outcome(lambda: bytearray(2**62), capsys)
        assert_refused(outcome, "the memory is full; use fewer rows")

    def test_warnings_of_other_libraries_are_not_shown(self, capsys: pytest.CaptureFixture[str]) -> None:
        outcome = self.outcome(lambda: np.log(np.zeros(1)), capsys)
        assert outcome == Outcome(0, "", "")

    def test_own_ones_are_and_stand_in_the_json(self, capsys: pytest.CaptureFixture[str]) -> None:
        def go() -> None:
            logging.getLogger("magloc.anything").warning("a doubt")
            warnings.warn("a sky", AmbiguousSkyWarning, stacklevel=1)
            framework.print_report({"rows": 1})

        outcome = self.outcome(go, capsys)
        assert json.loads(outcome.out) == {"rows": 1, "warnings": ["a doubt", "a sky"]}
        assert outcome.err == "magloc: warning: a doubt\nmagloc: warning: a sky\n"
        assert json.loads(self.outcome(lambda: framework.print_report({}), capsys).out) == {"warnings": []}


class TestJsonLists:
    @pytest.mark.parametrize("n", [0, 1, 3])
    def test_are_what_one_value_would_be(self, n: int, capsys: pytest.CaptureFixture[str]) -> None:
        """The oracle is Python's own encoder."""
        entries = [{"x": [0.5, None], "µ": "ä"}] * n
        print_json_list("results", iter(entries))
        assert (
            capsys.readouterr().out
            == json.dumps({"results": entries, "warnings": []}, separators=(",", ":"), ensure_ascii=False) + "\n"
        )


class TestCommonOptions:
    @pytest.mark.parametrize(("threads", "used"), [((), []), (("--threads", "1"), [1]), (("--threads", "999"), [MOST])])
    def test_threads_are_those_of_kernels(
        self,
        threads: tuple[str, ...],
        used: list[int],
        recording: tuple[Path, Path],
        run: Run,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        set_to: list[int] = []
        monkeypatch.setattr(core, "set_threads", set_to.append)
        monkeypatch.setattr("os.cpu_count", lambda: MOST)
        readings, array = recording
        assert run("locate", readings, "--array", array, *threads).status == 0
        assert set_to == used

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("quiet", [False, True])
    def test_quiet_says_nothing_of_what_is_written(
        self, quiet: bool, recording: tuple[Path, Path], tmp_path: Path, run: Run
    ) -> None:
        readings, array = recording
        outcome = run("locate", readings, "--array", array, "--out", tmp_path, *(["--quiet"] if quiet else []))
        assert outcome.status == 0
        assert (outcome.err == "") is quiet


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Readings and array files of one row."""
    folder = tmp_path_factory.mktemp("recording")
    file = folder / "array.toml"
    file.write_text('geometry = "tetrahedron"\nedge_m = 1.5\nkind = "vector"\nnoise_nT = 1.0\n')
    names = [f"{sensor}_{axis}_nT" for sensor in read_array(file).ids for axis in "xyz"]
    values = [f"{100.0 / (1 + k):.3f}" for k in range(len(names))]
    (folder / "readings.csv").write_text(f"time_s,{','.join(names)}\n0,{','.join(values)}\n")
    return folder / "readings.csv", file


class TestSignsOfLife:
    """A command that shows no progress of its own tells a terminal that it runs."""

    def told(self, monkeypatch: pytest.MonkeyPatch, *tokens: str, watched: bool, bar: bool = False) -> list[str]:
        """Notes of a command that waits for three of them, where there may be some."""
        import tqdm  # noqa: F401 - a bar loads it, which takes longer than the first sign

        notes: list[str] = []
        seen = threading.Event()

        def note(text: str, _: str) -> None:
            notes.append(text)
            if len(notes) == 3:
                seen.set()

        app = cyclopts.App(name="magloc")

        @app.command
        def work(*, common: framework.QuietOptions = framework.QuietOptions()) -> None:  # noqa: B008 - frozen
            with framework.progress(1, "rows") if bar else contextlib.nullcontext():
                seen.wait(WAIT_S if watched and not common.quiet and not bar else 0.2)

        monkeypatch.setattr(framework, "_FIRST_SIGN_S", 0.01)
        monkeypatch.setattr(framework, "print_note", note)
        monkeypatch.setattr(sys.stderr, "isatty", lambda: watched)
        framework.call(app, ["work", *tokens])
        return notes

    def test_at_growing_intervals(self, monkeypatch: pytest.MonkeyPatch) -> None:
        assert self.told(monkeypatch, watched=True)[:3] == [f"still computing after {s} s" for s in (0.01, 0.02, 0.04)]

    def test_not_into_a_pipe_nor_quietly_nor_beside_a_bar(self, monkeypatch: pytest.MonkeyPatch) -> None:
        assert self.told(monkeypatch, watched=False) == []
        assert self.told(monkeypatch, "--quiet", watched=True) == []
        assert self.told(monkeypatch, watched=True, bar=True) == []


@pytest.mark.slow_after(2)
@pytest.mark.parametrize(
    ("program", "shell"), [("magloc", "bash"), ("adcs", "zsh"), ("magloc", "zsh"), ("adcs", "bash")]
)
def test_completion_of_commands_and_options(
    program: str, shell: str, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("HOME", "XDG_DATA_HOME", "ZDOTDIR"):
        monkeypatch.setenv(name, str(tmp_path))
    run: Run = request.getfixturevalue("run" if program == "magloc" else program)
    done = run("--install-completion", "--shell", shell)
    assert done.status == 0, done.err
    scripts = [path.read_text() for path in tmp_path.rglob("*") if path.is_file()]
    assert any("--json" in script and "demo" in script for script in scripts)
