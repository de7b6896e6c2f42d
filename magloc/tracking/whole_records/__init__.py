"""Tracks of whole records: what later rows tell, too."""
