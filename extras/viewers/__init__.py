"""Viewers beside the window and the page: rerun and viser. Each is a flag of `splatnode view`."""
