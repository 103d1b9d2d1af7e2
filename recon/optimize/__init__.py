"""Joint refinement of Gaussians and cameras: losses, regularisation, density control, divergence."""
