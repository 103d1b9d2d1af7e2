"""Viewers beside the window and the page: Foxglove, rerun and viser. Files for them, and flags of `splatnode view`."""
