"""``magloc warm-up``: what other commands compile when they are first used is compiled ahead."""

from __future__ import annotations

import tempfile
from pathlib import Path

import magloc
from magloc.cli import framework
from magloc.cli.framework import QuietOptions


def warm_up(*, common: QuietOptions = QuietOptions()) -> None:  # noqa: B008 - frozen
    """Compile ahead what locate, track, map and bounds compile when they are first used, for this machine and version.

    Parameters
    ----------
    common : QuietOptions
        Common options.
    """
    from magloc.cli.app import app

    path = magloc.datasets.load("ship").path
    board = magloc.datasets.load("board").path
    recording = (str(path), "--array", str(path.with_name("ship-array.toml")))
    maps = [["map", "--method", method, "--grid", "2"] for method in ("repeated", "iekf", "damped", "global")]
    maps += [["map", "--over", "sources", "--grid", "3"], ["bounds", "--grid", "3"]]
    with tempfile.TemporaryDirectory() as folder:
        # Long records are stepped by compiled code where no sensor has errors that last, as in none of the data sets.
        plain = (str(Path(folder) / "plain.csv"), str(Path(folder) / "plain-array.toml"))
        calls = [
            ["locate", *recording],
            ["track", *recording, "--speed-m-s", "2", "--smooth"],
            ["simulate", "weaving", "--out", plain[0]],
            ["track", plain[0], "--array", plain[1], "--speed-m-s", "0.1"],
            ["track", str(board), "--array", str(board.with_name("board-array.toml")), "--sources", "2"],
            *([*tokens, "--out", str(Path(folder) / str(i))] for i, tokens in enumerate(maps)),
        ]
        framework.warm_up(app, calls, common)
