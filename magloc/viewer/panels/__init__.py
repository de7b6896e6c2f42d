"""Inputs and readouts beside the scene."""
