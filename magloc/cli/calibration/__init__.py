"""``magloc calibrate``, by a source that moves past or by turning."""
