"""Satellite attitude determination on the magnetic models of :mod:`magloc`."""
