"""The command line ``adcs``: help, version, exit statuses, and what it refuses whatever the command."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version

import pytest

from adcs.cli.app import app, main
from adcs.environment.orbit import Sgp4Orbit
from arrays.io.errors import InputError
from magloc.cli import framework
from sims.cli.run import run as run_app
from tests.adcs.refusals import assert_refused
from tests.command_line import Run

COMMANDS = ("run", "compare", "tables", "estimate", "calibrate")
SCENARIOS = [name for name in run_app if not name.startswith("-")]


class TestHelp:
    @pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
    def test_names_every_command(self, adcs, arguments):
        outcome = adcs(*arguments)
        assert outcome.status == 0
        assert "Usage: adcs" in outcome.out
        assert all(command in outcome.out for command in COMMANDS)

    @pytest.mark.parametrize(
        "arguments", [*([command] for command in COMMANDS), ["run", "ellipsoid"], ["run", "complementary"]]
    )
    def test_of_a_command(self, adcs, arguments):
        outcome = adcs(*arguments, "--help")
        assert outcome.status == 0
        assert " ".join(["Usage: adcs", *arguments]) in outcome.out

    def test_version(self, adcs):
        outcome = adcs("--version")
        assert (outcome.status, outcome.out.strip()) == (0, version("magloc"))


class TestRefusals:
    @pytest.mark.parametrize(
        ("arguments", "fragments"),
        [
            (["fly"], ["fly"]),
            (["run", "tabletsat", "--sensor", "st"], ["--sensor", "--sensors"]),
            (["run", "tabletsat", "--seeds", "1.5"], ["--seeds"]),
            (["run", "tabletsat", "--filter", "ukf"], ["--filter", "mekf"]),
            *((["run", "--json", name], ["expected its name right after run"]) for name in SCENARIOS),
            (["run", "nosuch"], ["nosuch does not exist", *SCENARIOS]),
            (["run", "tabletsatt"], ["tabletsatt", "tabletsat", "ellipsoid", "complementary"]),
            (["compare"], ["no scenario"]),
            (["estimate", "telemetry.csv"], ["--config"]),
            (["tables", "--duration", "0"], ["--duration"]),
        ],
    )
    def test_one_line(self, adcs, arguments, fragments):
        assert_refused(adcs(*arguments), *fragments)


class TestExitStatus:
    def test_interruption(self, adcs, monkeypatch):
        def interrupted(*_):
            raise KeyboardInterrupt

        monkeypatch.setattr(framework, "call", interrupted)
        outcome = adcs("tables")
        assert (outcome.status, outcome.err) == (130, "adcs: interrupted\n")

    def test_disk(self, adcs, monkeypatch):
        def full(*_):
            raise OSError(28, "No space left on device", "somewhere.csv")

        monkeypatch.setattr(framework, "call", full)
        outcome = adcs("tables")
        assert (outcome.status, outcome.err) == (2, "adcs: somewhere.csv: No space left on device\n")

    def test_reader_that_is_gone(self):
        """What ``adcs run … | head -0`` does: no traceback when the pipe is closed."""
        program = "import sys; from adcs.cli.app import main; sys.stdin.readline(); sys.exit(main(sys.argv[1:]))"
        with subprocess.Popen(
            [sys.executable, "-c", program, "run", "ellipsoid", "--seeds", "1", "--duration", "10"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            assert process.stderr is not None
            process.stdout.close()
            process.stdin.write("\n")
            process.stdin.close()
            error = process.stderr.read()
        assert (process.returncode, error) == (framework.BROKEN_PIPE, "")


def test_the_process_arguments(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["adcs", "--version"])
    assert main() == 0
    assert capsys.readouterr().out.strip() == version("magloc")
    assert app.name == ("adcs",)


class TestMissingExtra:
    @pytest.mark.parametrize(
        ("module", "arguments", "sentence"),
        [
            ("erfa", [], 'the rotation of the Earth needs the extra "satellites": pip install "magloc[satellites]".'),
            ("netCDF4", ["--out", "out"], 'a netCDF file needs the extra "maps": pip install "magloc[maps]".'),
        ],
    )
    def test_of_a_run(self, adcs, monkeypatch, tmp_path, module, arguments, sentence):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setitem(sys.modules, module, None)
        assert_refused(adcs("run", "tabletsat", "--seeds", "1", "--duration", "2", *arguments), sentence)
        assert not list(tmp_path.iterdir())

    def test_of_two_line_elements(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "sgp4.api", None)
        with pytest.raises(InputError, match='two-line elements needs the extra "satellites"'):
            Sgp4Orbit("1", "2")


@pytest.mark.parametrize(
    "command", ["run tabletsat", "run complementary", "run ellipsoid", "run mockup", "compare tabletsat", "tables"]
)
def test_more_runs_than_would_ever_end_are_refused(command: str, adcs: Run) -> None:
    outcome = adcs(*command.split(), "--seeds", "9" * 18)
    assert outcome.status == 2
    (line,) = outcome.err.splitlines()
    assert "--seeds" in line
    assert "10000000" in line
