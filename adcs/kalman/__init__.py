"""Kalman filters of the attitude: MEKF, its variants, initialisation and results."""
