"""What is raised for files that cannot be used."""

from __future__ import annotations


class InputError(ValueError):
    """Bad input from outside: a file, a command's option.

    The text is one sentence that names the file, the line or key, what was found and what was expected, fit to be shown
    to a user as it is.
    """
