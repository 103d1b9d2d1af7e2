"""Rival methods, written from their publications: a method is a module with `reconstruct(frames, seed)`."""
