"""Export formats of other viewers: Foxglove and rerun."""
