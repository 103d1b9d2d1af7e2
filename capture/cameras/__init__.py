"""One file a source, each with `Config`, `stream(config)` and, for devices, `find()`."""
