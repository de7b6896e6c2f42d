"""What is known of a tracked source: coordinates, mixtures of Gaussians in them, and how rows change these."""
