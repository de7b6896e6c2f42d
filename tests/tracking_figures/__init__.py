"""Figures of tracks on fixed seeds, and those that are stored: ``python -m tests.tracking_figures --compare``."""
