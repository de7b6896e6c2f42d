"""The first commands of a new user: an array file, the layout of a log, a demonstration."""
