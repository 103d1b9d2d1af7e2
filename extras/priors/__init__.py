"""Priors beside the core's: each matches photographs, or gives depth, by a network."""
