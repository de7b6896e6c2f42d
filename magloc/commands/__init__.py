"""The commands of ``magloc``, one module each; :mod:`magloc.cli` registers and runs them.

What is slow to load is imported inside the functions, because every run of any command loads all of these modules.
"""
