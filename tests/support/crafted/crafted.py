"""Crafted: a file with a trick in it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Crafted:
    name: str  # of the file, unique among its kind; the suffix tells which reader it is meant for
    data: bytes
    trick: str
