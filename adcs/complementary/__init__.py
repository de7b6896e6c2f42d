"""Complementary filters of the attitude, and inertial-magnetic units."""
