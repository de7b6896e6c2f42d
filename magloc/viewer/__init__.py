"""Results seen in three dimensions, in a browser (viser)."""
