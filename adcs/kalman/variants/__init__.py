"""Variants of the MEKF: constant gain, gyro as input, separate bias, and a bank of filters."""
