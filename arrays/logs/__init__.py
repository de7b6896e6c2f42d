"""Logs of other programs: their text, clocks and places become the columns of a readings file."""
