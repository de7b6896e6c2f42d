"""Uncertainty of an optimum: covariance, other optima, range."""
