"""One fix: where a dipole is, from one set of readings."""
