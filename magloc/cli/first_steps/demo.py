"""``magloc demo``: a first example without any files."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from magloc.cli import framework
from magloc.cli.framework import Flag, QuietOptions

_VIEWER = ("viser", "trimesh")


def demo(
    out: Path = Path("magloc-demo"),
    /,
    *,
    view: Flag = False,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Simulate, locate and track a magnet by four commands, and compare the results with the truth.

    Parameters
    ----------
    out : Path
        Folder for the files of the commands.
    view : bool
        Show the scene in the browser at the end, until Ctrl-C.
    common : QuietOptions
        Common options.
    """
    from magloc.cli.app import app

    readings, array, truth = (str(out / f"target{ending}") for ending in (".csv", "-array.toml", "-truth.csv"))
    motion = ("--speed-m-s", "0.1", "--turn-deg-s", "1.2")
    calls = [
        ("simulate", "weaving", "--out", readings),
        ("locate", readings, "--array", array, "--json"),
        ("track", readings, "--array", array, *motion, "--json", "--out", str(out / "track")),
        ("view", readings, "--html", str(out / "target.html")),
    ]
    has_viewer = all(map(find_spec, _VIEWER))
    _, fixes, track, *_ = framework.demonstrate(app, out, calls if has_viewer else calls[:-1], common)
    if not common.quiet:
        page = f"{out / 'target.html'}, in a browser" if has_viewer else 'pip install "magloc[view]" brings one'
        seen = f"Picture:  {out / 'track' / 'track.png'}\n3-D page: {page}"
        print(_story(json.loads(fixes), json.loads(track), truth), seen, _NEXT, sep="\n")
    if view:
        framework.call(app, ["view", readings])


def _story(fixes: dict[str, Any], track: dict[str, Any], truth_file: str) -> str:
    """Return the results of the commands, compared with the truth."""
    import numpy as np

    truth = np.genfromtxt(truth_file, delimiter=",", names=True)
    expected = np.stack([truth["x_m"], truth["y_m"], truth["z_m"]], axis=1)
    last = track["results"][-1]
    places = ([row["solutions"][0] for row in fixes["results"]], track["results"])
    errors = [np.linalg.norm([row["position_m"] for row in rows] - expected, axis=1) for rows in places]
    rms_m = [float(np.sqrt(np.mean(error**2))) for error in errors]
    at = ", ".join(f"{x:.2f}" for x in last["position_m"])
    claimed_m = float(np.sqrt(np.trace(np.array(last["covariance"])[:3, :3])))
    duration_s = truth["time_s"][-1]
    return f"""
Simulated: a magnet that weaves past four magnetometers with 0.2 nT of noise, {len(truth)} rows in {duration_s:.0f} s.
Found:     `locate` takes each row alone and is {rms_m[0]:.2f} m off (rms); `track` joins the rows, {rms_m[1]:.2f} m.
At the end the magnet is at ({at}) m. The track is {errors[1][-1]:.2f} m off, and says ±{claimed_m:.2f} m (1 σ)."""


_NEXT = """Next, with sensors and a log of your own:
  magloc new-array                               describes your sensors in a file
  magloc locate LOG.csv --array ARRAY.toml       finds the magnet in every row of your log"""
