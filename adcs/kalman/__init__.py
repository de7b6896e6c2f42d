"""Kalman filters of the attitude: the multiplicative filter, its reduced relatives, their starts and their results."""
