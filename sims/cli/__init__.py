"""Commands that simulate; the command lines register them by name."""
