"""Connected components of a graph of frames."""

from __future__ import annotations

from collections.abc import Iterable


def find_components(nodes: Iterable[int], edges: Iterable[tuple[int, int]]) -> list[list[int]]:
    """The connected components of the undirected graph, the largest first; equally large ones by their first nodes."""
    label = {node: node for node in nodes}
    for i, j in edges:
        old, new = max(label[i], label[j]), min(label[i], label[j])
        label = {node: new if name == old else name for node, name in label.items()}
    groups = [[node for node, name in label.items() if name == group] for group in sorted(set(label.values()))]
    return sorted(groups, key=lambda group: (-len(group), group))
