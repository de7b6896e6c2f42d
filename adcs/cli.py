"""The command line ``adcs``.

Every command is a function in a module of :mod:`adcs.commands`; its NumPy docstring is its help text. What the command
lines have in common is in :mod:`magloc.command_line`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cyclopts import App, Parameter

from adcs.commands.compare import compare
from adcs.commands.estimate import estimate
from adcs.commands.run_complementary import complementary
from adcs.commands.run_ellipsoid import ellipsoid
from adcs.commands.run_mockup import mockup
from adcs.commands.run_tabletsat import run_attitude
from adcs.commands.stars import stars
from adcs.commands.tables import tables
from magloc import command_line

app = App(
    name="adcs",
    help="Determine the attitude of satellites.",
    version=command_line.installed_version,
    default_parameter=Parameter(negative=()),
)
run = App(
    name="run",
    help="Simulate a scenario, estimate its attitude, and say how good that is.",
    version_flags=[],
)
run.default(run_attitude)
run.command(complementary)
run.command(ellipsoid)
run.command(mockup)
app.command(run)
app.command(compare)
app.command(tables)
app.command(estimate)
app.command(stars)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    arguments : sequence of str, optional
        The command and its arguments; by default those of the process.

    Returns
    -------
    int
        Exit status: 0 done, 2 bad input, 130 interrupted, 141 the reader of the output is gone.
    """
    return command_line.run(app, arguments)


if __name__ == "__main__":
    sys.exit(main())
