"""Messages of Foxglove's schemas as an MCAP file. Needs the extra mcap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mcap.writer import Writer

from splatnode.recon.result.export.foxglove import Message, written


def encoded(messages: Sequence[Message], schemas: Mapping[str, str]) -> bytes:
    """The file; `schemas` names that of each topic."""
    return written(Writer, messages, schemas)
