"""Truth and readings of magnetometer arrays and dipoles."""
