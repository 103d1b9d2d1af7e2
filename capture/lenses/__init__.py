"""Lens models, one a file: from rays of the camera's frame to pixels of the picture, and back."""
