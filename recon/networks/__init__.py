"""Learned networks: their building blocks, their weights, and the networks that several rooms use."""
