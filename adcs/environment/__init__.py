"""Orbit, Sun and geomagnetic field along the orbit."""
