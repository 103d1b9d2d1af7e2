"""Photographs in, camera poses and a 3D Gaussian scene out, on a CPU."""
