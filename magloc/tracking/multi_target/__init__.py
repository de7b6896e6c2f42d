"""Several moving sources in one filter."""
