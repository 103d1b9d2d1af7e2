"""Text files of numbers, for formats that people can read."""

from __future__ import annotations

from collections.abc import Sequence

from splatnode.recon.result.scale import Scale


def format_number_row(values: Sequence[float]) -> str:
    """The numbers with spaces between them, each so that it reads back exactly."""
    return " ".join(str(int(value)) if float(value).is_integer() else repr(float(value)) for value in values)


def format_text_file(head: str, lines: Sequence[str], scale: Scale) -> bytes:
    """The comment `head`, a comment that states the scale, and the lines."""
    return ("\n".join([f"# {head}", f"# scale: {scale.sentence}", *lines]) + "\n").encode()
