"""Frames to camera poses and a Gaussian scene."""
