"""Mangled files, streams and arguments for every command: one sentence, never a traceback, a hang or half a file."""
