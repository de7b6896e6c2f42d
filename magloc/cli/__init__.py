"""The command line ``magloc``, one file a command."""
