"""Inputs and outputs beside the scene."""
