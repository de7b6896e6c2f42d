"""The command line ``adcs``, which has no command yet and says so."""

from __future__ import annotations

from importlib.metadata import version

import pytest

from adcs.cli import main


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_help(arguments, capsys):
    assert main(arguments) == 0
    assert "Usage: adcs" in capsys.readouterr().out


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == version("magloc")


def test_anything_else_is_refused_in_one_line(capsys):
    assert main(["run", "tabletsat"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert "run tabletsat" in err
