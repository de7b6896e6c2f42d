"""Stars identified in frames of a star camera."""
