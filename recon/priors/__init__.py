"""Priors: each proposes matches where plain features find few, and gives depth to registered cameras."""
