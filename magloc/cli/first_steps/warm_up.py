"""``magloc warm-up`` and ``adcs warm-up``, which compiled kernels in earlier releases."""

from __future__ import annotations

import logging

from magloc.cli.framework import QuietOptions


def warm_up(*, common: QuietOptions = QuietOptions()) -> None:  # noqa: B008 - frozen
    """Do nothing. The kernels are compiled at installation; the next release removes `warm-up`.

    Parameters
    ----------
    common : QuietOptions
        Common options.
    """
    logging.getLogger(__name__).info("warm-up has nothing to do: the package is compiled when it is installed")
