"""Density controls, which change the number of Gaussians during the refinement; control.py is their interface."""
