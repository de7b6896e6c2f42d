"""Fusion of late camera fixes with the inertial unit in the plane."""
