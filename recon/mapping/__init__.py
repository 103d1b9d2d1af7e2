"""A map of a long recording, offline: the scenes that a node would make of it, merged."""
