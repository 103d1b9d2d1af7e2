"""The reconstruction as a daemon: keyframes in, scenes out; no keyframe that it acknowledged is lost."""
