"""``adcs warm-up``: nothing is left to compile; the command stays for one release."""

from __future__ import annotations

from magloc.cli.framework import QuietOptions, print_note


def warm_up(*, common: QuietOptions = QuietOptions()) -> None:  # noqa: B008 - frozen
    """Say that nothing is left to compile: the filters were compiled when the package was built.

    Parameters
    ----------
    common : QuietOptions
        Common options.
    """
    if not common.quiet:
        print_note("nothing is left to compile: the filters were compiled when the package was built", "adcs")
