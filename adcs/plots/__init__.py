"""Figures of :mod:`adcs`. Only the command line draws."""
