"""The command line ``adcs``, one file a command."""
