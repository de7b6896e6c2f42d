"""The command line ``magloc``.

Every command is a function in a module of :mod:`magloc.commands`; its NumPy docstring is its help text. It raises
:class:`arrays.errors.InputError` for bad input. What the command lines have in common is in :mod:`magloc.command_line`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cyclopts import App, Parameter

from magloc import command_line
from magloc.commands.bounds import bounds
from magloc.commands.calibrate import calibrate
from magloc.commands.design import design
from magloc.commands.locate import locate
from magloc.commands.map import map_
from magloc.commands.simulate import simulate
from magloc.commands.track import track
from magloc.commands.view import view

app = App(
    name="magloc",
    help="Find magnetic dipoles from the differences between magnetometers.",
    version=command_line.installed_version,
    default_parameter=Parameter(negative=()),
)
app.command(calibrate)
app.command(locate)
app.command(map_, name="map")
app.command(track)
app.command(bounds)
app.command(design)
app.command(simulate)
app.command(view)


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
