"""Satellite: dynamics, sensors and records of readings."""
