"""The command line ``magloc``.

Every command is a function in a module of :mod:`magloc.cli`; its NumPy docstring is its help text. It raises
:class:`arrays.io.errors.InputError` for bad input. What the command lines have in common is in
:mod:`magloc.cli.framework`.
"""

from __future__ import annotations

from collections.abc import Sequence

from magloc.cli import framework

COMMANDS = (
    (
        "calibrate",
        "magloc.cli.calibration.calibrate:calibrate",
        "Calibrate vector sensors by a source that moves past them, or by turning them in a field of known modulus.",
    ),
    ("locate", "magloc.cli.locate:locate", "Find the sources in every row of a readings file, each row on its own."),
    (
        "map",
        "magloc.cli.map:map_",
        "Draw the convergence map of a filter over a cube of starts, or that of start-free fixes over a cube of"
        " sources.",
    ),
    ("track", "magloc.cli.track:track", "Follow one source through time."),
    ("live", "magloc.cli.live:live", "Follow one source while its readings come in."),
    (
        "signature",
        "magloc.cli.moments.signature:signature",
        "Separate the permanent and the induced moment of a ship that passes on known courses.",
    ),
    (
        "bounds",
        "magloc.cli.bounds:bounds",
        "Tell how well an array can know a source at best (Cramér-Rao bounds), and how far it reaches.",
    ),
    (
        "design",
        "magloc.cli.design:design",
        "Design an array: place its sensors for the sources that it is to locate.",
    ),
    (
        "new-array",
        "magloc.cli.first_steps.new_array:new_array",
        "Write an array file: a shape, a size and a sensor, by options or by answering questions.",
    ),
    (
        "columns",
        "magloc.cli.first_steps.columns:columns",
        "Propose the table [columns] of an array file for the log of another program.",
    ),
    (
        "survey",
        "magloc.cli.survey:survey",
        "Find targets at rest in the ground that sensors moved over.",
    ),
    ("demo", "magloc.cli.first_steps.demo:demo", "Simulate, locate and track a source, and draw what comes out."),
    ("simulate", "sims.cli.simulate:simulate", "Simulate the readings of an array."),
    ("view", "magloc.cli.view:view", "See an array, readings, a track or a map in three dimensions."),
    (
        "warm-up",
        "magloc.cli.first_steps.warm_up:warm_up",
        "Do nothing: no command compiles anything any more. The next release removes it.",
    ),
)
app = framework.new_program("magloc", "Find magnetic dipoles from the differences between magnetometers.", COMMANDS)


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
    return framework.run(app, arguments)
