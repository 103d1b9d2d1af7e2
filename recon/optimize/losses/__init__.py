"""Losses beside the photometric one, one a file; loss.py is their interface."""
