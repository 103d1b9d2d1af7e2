"""The files that a map of three states is written as, one a module."""
