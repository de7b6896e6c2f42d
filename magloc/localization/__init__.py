"""Fixes: locations of dipoles from single sets of readings."""
