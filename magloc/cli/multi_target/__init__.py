"""Several moving sources."""
