"""The satellite: its dynamics, its sensors, and the record of what they read."""
