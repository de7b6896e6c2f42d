"""Calibration of arrays: gains, axes, offsets and places of sensors."""
