"""How certain an optimum is: covariance, other optima, range."""
