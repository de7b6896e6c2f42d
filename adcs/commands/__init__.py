"""The commands of ``adcs``, one module each."""
