"""Navigation: measured poses, velocities and rates that accompany the readings."""
