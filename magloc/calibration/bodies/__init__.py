"""Calibration of a body's magnets together with the sensors."""
