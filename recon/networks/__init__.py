"""Learned networks: their parts, and images through those that several rooms of the reconstruction use."""
