"""A source followed through time."""
