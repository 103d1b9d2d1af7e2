"""Metres for a scene that photographs leave without a unit: what was measured, and what all of it says together."""
