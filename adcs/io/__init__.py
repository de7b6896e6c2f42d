"""Files of :mod:`adcs`: scenarios, telemetry, estimates, recordings."""
