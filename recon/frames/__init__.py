"""Single frames: keyframes with their features, screening, black borders."""
