"""Truth and readings of the table-top satellite, for :mod:`adcs.mockup`."""
