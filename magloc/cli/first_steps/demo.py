"""``magloc demo``: from nothing to a picture."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from magloc.cli import framework
from magloc.cli.framework import QuietOptions
from magloc.cli.options import print_note


def demo(
    out: Path = Path("magloc-demo"),
    /,
    *,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Simulate, locate and track a source, and draw what comes out: four commands, each shown as it is typed.

    Parameters
    ----------
    out : Path
        Folder for what they write.
    common : QuietOptions
        Common options.
    """
    from magloc.cli.app import app

    readings, array, truth = (str(out / f"target{ending}") for ending in (".csv", "-array.toml", "-truth.csv"))
    motion = ("--speed-m-s", "0.1", "--turn-deg-s", "1.2")
    calls = [
        ("simulate", "weaving", "--out", readings),
        ("locate", readings, "--array", array),
        ("track", readings, "--array", array, *motion, "--truth", truth, "--out", str(out / "track")),
        ("view", readings, "--html", str(out / "target.html")),
    ]
    seen = calls if find_spec("viser") and find_spec("trimesh") else calls[:-1]
    framework.demonstrate(app, out, seen, common)
    if not common.quiet:
        print_note(f"the picture is {out / 'track' / 'track.png'}")
        page = (
            "magloc[view] has a scene to turn as well"
            if len(seen) < len(calls)
            else f"a scene is {out / 'target.html'}"
        )
        print_note(page)
