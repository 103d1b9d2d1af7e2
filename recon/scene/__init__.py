"""The scene: cameras and Gaussians, and how they begin and grow (seeding, completion, far background)."""
