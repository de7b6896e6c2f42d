"""Moments of objects on known paths: tracks, and permanent, induced and eddy parts."""
