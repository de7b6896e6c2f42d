"""Templates of instruments: array files for logs in a maker's format."""
