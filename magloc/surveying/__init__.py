"""Surveys: static targets from all rows of moving sensors together."""
