"""Figures of :mod:`adcs`; only its command line draws."""
