"""Whether there is a source at all, and how far off one is found."""
