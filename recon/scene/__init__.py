"""The scene: training views and Gaussians, and how they begin (completion, seeding, far shell), grow and warp."""
