"""One file a prior; each turns keyframes into cameras and point maps."""
