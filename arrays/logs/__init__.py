"""Logs of other programs, converted to the columns of a readings file."""
