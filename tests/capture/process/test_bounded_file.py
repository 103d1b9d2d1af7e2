"""Whatever a stranger calls a file, reading it is refused by the reader's own error."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatnode.capture.image_file import UnusableImage, find_common_range
from splatnode.capture.process.files import read_bounded


def test_a_name_with_a_null_byte_is_refused(tmp_path):
    with pytest.raises(UnusableImage, match="null byte"):
        read_bounded(Path("a\0.png"), 100, UnusableImage)
    assert find_common_range([Path("a\0.png")]) is None
