"""Joint filter of several moving sources."""
