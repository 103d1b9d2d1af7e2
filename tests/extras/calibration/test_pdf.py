from __future__ import annotations

import re

import pytest

from splatnode.extras.calibration.board import PAPERS, Page, Rectangle, Text, pdf_of


def test_the_table_says_where_each_object_begins():
    page = Page(PAPERS["a4"], [Rectangle(10, 20, 30, 40)], [Text(5, 6, 3, "one")])
    file = pdf_of([page, page], "two pages")
    at = int(re.search(rb"startxref\n(\d+)", file)[1])  # type: ignore[index]
    assert file[at:].startswith(b"xref\n0 9\n")
    begins = [int(line[:10]) for line in re.findall(rb"\d{10} 00000 n \n", file)]
    assert [file[begin : begin + 7] for begin in begins] == [b"%d 0 obj" % number for number in range(1, 9)]
    assert b"/Count 2 /Kids [5 0 R 7 0 R]" in file
    for length, content in re.findall(rb"/Length (\d+) >>\nstream\n(.*?)\nendstream", file, re.DOTALL):
        assert int(length) == len(content)


def test_a_rectangle_is_in_millimetres_from_the_upper_border():
    file = pdf_of([Page(PAPERS["a4"], [Rectangle(10, 20, 30, 40)])], "one")
    assert b"/MediaBox [0 0 595.275591 841.889764]" in file  # 210 x 297 mm in 1/72 inch
    assert b"2.834646 0 0 2.834646 0 0 cm" in file
    assert b"10 237 30 40 re" in file  # 297 - 20 - 40: a PDF's y is up


def test_brackets_do_not_end_a_text_and_other_alphabets_are_refused():
    assert rb"(a \(b\) \\c)" in pdf_of([Page(PAPERS["letter"], [], [Text(0, 9, 3, r"a (b) \c")])], "t")
    with pytest.raises(ValueError, match="Latin-1"):
        pdf_of([Page(PAPERS["a4"], [], [Text(0, 9, 3, "\u4e00")])], "t")
    with pytest.raises(ValueError, match="must have a page"):
        pdf_of([], "t")
