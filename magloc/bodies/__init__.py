"""Rigid bodies of several magnets: their files, fields, poses and tracks."""
