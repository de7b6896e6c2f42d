"""What every package reads and writes with: errors, text, TOML, CSV, outputs."""
