"""Held-out evaluation: protocol, metrics, methods, charts."""
