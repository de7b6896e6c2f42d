"""Magnetic models, and the estimation of magnetic dipoles from the differences between sensors."""
