"""A small neural radiance field whose cameras are learnt with it: what nerfmm and nope-nerf share."""
