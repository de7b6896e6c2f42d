"""The first commands of a new user: an array file, a demonstration, compiling ahead."""
