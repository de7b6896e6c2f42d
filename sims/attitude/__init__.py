"""Truth and readings of satellites' attitude, for the filters of :mod:`adcs`."""
