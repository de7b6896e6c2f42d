"""``adcs demo``: from nothing to a picture."""

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
    simulated, estimated = framework.demonstrate(app, out, calls, common)
    if not common.quiet:
        print(_STORY.format(simulated=simulated, estimated=estimated, picture=out / "estimates" / "estimates.png"))


_STORY = """
Simulated: a small satellite that its wheels hold for 300 s, and how far the filter is off. NEES 1 is as far as it says.
{simulated}
Estimated from the file of its sensors alone:
{estimated}
Picture: {picture}
Next, with telemetry of your own:
  adcs estimate TELEMETRY.csv --config SATELLITE.toml"""
