"""Export formats, one a module: `--to spz` is the module spz. `export/format.py` says what a module must have."""
