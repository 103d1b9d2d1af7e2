"""Strangers who wait for a place: whose turn it is to go, so that one machine's crowd takes nothing from another's."""

from __future__ import annotations

import collections
import ipaddress
from collections.abc import Mapping
from typing import TypeVar

_NETWORK_BITS = 64  # of an IPv6 address: one network has all that follow

Place = TypeVar("Place")


def network_of(host: str) -> str:
    """The machine, or the IPv6 network, that a numeric address belongs to. Raises ValueError."""
    address = ipaddress.ip_address(host.partition("%")[0])
    if address.version == 4:
        return str(address)
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.ip_network((int(address), _NETWORK_BITS), strict=False))


def next_to_go(networks: Mapping[Place, str]) -> Place:
    """The oldest place, which comes first, of the network that has the most. Raises ValueError where there is none."""
    crowd = max(collections.Counter(networks.values()).items(), key=lambda each: each[1])[0]
    return next(place for place, network in networks.items() if network == crowd)
