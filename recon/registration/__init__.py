"""Unposed, uncalibrated frames to camera poses: features, matches, two-view geometry, mapping, bundle adjustment."""
