"""Files of :mod:`adcs`: scenarios, telemetry, estimates and frames."""
