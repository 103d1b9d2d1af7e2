"""The place that the synthetic camera photographs: solids, their textures, their light and their layout."""
