"""Commands of ground surveys."""
