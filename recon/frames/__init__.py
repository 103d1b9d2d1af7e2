"""Single frames: keyframes with their features, screening, given distortion removed, black borders."""
