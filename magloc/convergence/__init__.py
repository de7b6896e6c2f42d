"""Convergence maps: from which starts, and to which sources, a filter finds its way."""
