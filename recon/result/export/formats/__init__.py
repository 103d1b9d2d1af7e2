"""Export formats, one a module: `--to spz` is the module spz. `export` itself says what a module must have."""
