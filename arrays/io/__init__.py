"""Reading and writing for all packages: errors, text, TOML, CSV, outputs."""
