"""Forward models: fields of dipoles, multipoles, bodies, coils, and of the Earth."""
