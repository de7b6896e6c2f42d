"""Arrays designed for a task."""
