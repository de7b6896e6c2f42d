"""Inertial units on Earth: gaps in their readings, the direction up, and logs that are misread."""
