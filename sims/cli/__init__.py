"""Commands that simulate; the command lines load them by name."""
