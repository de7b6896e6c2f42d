"""Fusion of delayed camera fixes with a planar inertial unit."""
