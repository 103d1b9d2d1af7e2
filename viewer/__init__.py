"""Snapshots to the screen. Never torch, never the optimiser."""
