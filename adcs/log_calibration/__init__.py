"""Calibration of magnetometers, gyro and accelerometer from an ordinary flight or drive."""
