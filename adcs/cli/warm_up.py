"""``adcs warm-up``: what other commands compile when they are first used is compiled ahead."""

from __future__ import annotations

import adcs
from adcs.complementary.names import METHODS
from magloc.cli import framework
from magloc.cli.framework import QuietOptions


def warm_up(*, common: QuietOptions = QuietOptions()) -> None:  # noqa: B008 - frozen
    """Compile ahead what run, estimate and imu compile when they are first used, for this machine and version.

    Parameters
    ----------
    common : QuietOptions
        Common options.
    """
    from adcs.cli.app import app

    few = ("--seeds", "1", "--duration", "60")
    filters = ("mekf", "constant-gain", "parallel-disturbance", "smoother")
    calls = [
        *(("run", "tabletsat", "--filter", name, *few) for name in filters),
        ("run", "tabletsat", "--sensors", "mag+sun+gyro", "--states", "gyro-bias", *few),
        *(("run", "complementary", "--filter", name) for name in METHODS),
        ("run", "ellipsoid", "--seeds", "1"),
        ("imu", str(adcs.datasets.load("imu").path), "--offline"),
    ]
    framework.warm_up(app, calls, common)
