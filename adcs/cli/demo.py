"""``adcs demo``: a first example without any files."""

from __future__ import annotations

from pathlib import Path

from magloc.cli import framework
from magloc.cli.framework import QuietOptions


def demo(
    out: Path = Path("adcs-demo"),
    /,
    *,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Simulate a satellite and estimate its attitude by two commands, shown as a user types them.

    Parameters
    ----------
    out : Path
        Folder for the files of the commands.
    common : QuietOptions
        Common options.
    """
    from adcs.cli.app import app

    telemetry, scenario = (str(out / "run" / name) for name in ("telemetry.csv", "scenario.toml"))
    calls = [
        ("run", "tabletsat", "--duration", "300", "--seeds", "1", "--out", str(out / "run")),
        ("estimate", telemetry, "--config", scenario, "--out", str(out / "estimates")),
    ]
    simulated, estimated = framework.demonstrate(app, out, calls, common)
    if not common.quiet:
        print(_STORY.format(simulated=simulated, estimated=estimated, picture=out / "estimates" / "estimates.png"))


_STORY = """
Simulated: a small satellite with wheels for 300 s, and the errors of the filter. NEES 1: errors as large as stated.
{simulated}
Estimated from the file of its sensors alone:
{estimated}
Picture: {picture}
Next, with telemetry of your own:
  adcs estimate TELEMETRY.csv --config SATELLITE.toml"""
