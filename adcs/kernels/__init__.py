"""Compiled hot loops of :mod:`adcs`, with the compiler options of :mod:`magloc.kernels`."""
