"""Compensation of the field of a platform: Tolles and Lawson's terms, and currents."""
