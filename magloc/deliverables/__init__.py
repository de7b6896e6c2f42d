"""Deliverables of a survey: files that a geographic information system opens, and a report."""
