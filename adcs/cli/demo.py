"""``adcs demo``: from nothing to a picture."""

from __future__ import annotations

from pathlib import Path

from adcs.cli.options import tell
from magloc.cli import framework
from magloc.cli.framework import QuietOptions


def demo(
    out: Path = Path("adcs-demo"),
    /,
    *,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Estimate the attitude of a simulated satellite, and draw what comes out: two commands, shown as they are typed.

    Parameters
    ----------
    out : Path
        Folder for what they write.
    common : QuietOptions
        Common options.
    """
    from adcs.cli.app import app

    telemetry, scenario = (str(out / "run" / name) for name in ("telemetry.csv", "scenario.toml"))
    calls = [
        ("run", "tabletsat", "--duration", "300", "--seeds", "1", "--out", str(out / "run")),
        ("estimate", telemetry, "--config", scenario, "--out", str(out / "estimates")),
    ]
    framework.demonstrate(app, out, calls, common)
    tell(common, f"the picture is {out / 'estimates' / 'estimates.png'}")
