"""Differentiable rasterisers behind one interface; `reference.py` is the definition."""
