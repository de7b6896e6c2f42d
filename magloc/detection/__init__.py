"""Detection of a source, and the distance at which an array detects one."""
