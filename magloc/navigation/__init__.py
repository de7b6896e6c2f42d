"""Navigation: poses, velocities and rates that are measured beside the readings."""
