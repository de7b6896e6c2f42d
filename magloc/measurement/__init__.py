"""Measurement models: from sources to the readings of an array."""
