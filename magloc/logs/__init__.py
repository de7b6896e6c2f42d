"""Logs of drones, robots and laboratories: their channels, clocks and sensors."""
