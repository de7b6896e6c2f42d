"""``adcs demo``."""

from __future__ import annotations

from pathlib import Path

from tests.command_line import Run


def test_demo(adcs: Run, tmp_path: Path) -> None:
    done = adcs("demo", tmp_path / "demo")
    assert done.status == 0, done.err
    assert [line.split()[2] for line in done.out.splitlines() if line.startswith("$ adcs ")] == ["run", "estimate"]
    assert (tmp_path / "demo" / "estimates" / "estimates.png").stat().st_size > 20_000
    assert "diverged runs                     0" in done.out
