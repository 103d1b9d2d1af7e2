"""Tests that need a machine of their own: a small virtual one with a real V4L2 driver, networks with bad links."""
