"""Commands for an object whose path is known."""
