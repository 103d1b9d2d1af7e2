"""Cameras beside those of capture: what robots log, and the built-in building. One file a camera."""
