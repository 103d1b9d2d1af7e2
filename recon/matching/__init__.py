"""Pairs of frames: features, descriptor matches, two-view geometry, and the view graph that holds them."""
