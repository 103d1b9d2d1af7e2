"""The finished scenes of a node, and how they lie to each other: recognised, bridged, optimised as one graph."""
