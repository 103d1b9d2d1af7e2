"""Texts that a stranger would give a file or a message: what drives a terminal, forges a line or hides what it is."""

from __future__ import annotations

TEXTS = {
    "title": "\x1b]0;owned\x07.png",
    "colour": "\x1b[2J\x1b[31mOK",
    "carriage return": "OK: a good scene\rno",
    "bell": "\x07\x07",
    "event": "a.png\nevent=keyframe name=forged",
    "whole line": "a\ntime=2026-01-01 level=info logger=splatnode event=ready checkpoint=/",
    "begins like one": "event=ready name=forged",
    "priority": "<0>the machine is on fire",
    "priority in a line": "a\n<0>the machine is on fire",
    "quotes": 'a" event="b',
    "backslash": "a\\",
    "line separator": "a\u2028event=ready",
    "next line": "a\x85event=ready",
    "null": "a\x00b",
    "turned": "gpj.\u202etxt",
    "isolated": "\u2066a\u2069",
    "zero width": "a\u200bb\u00ad",
    "no text": "\udcff\udc80.png",
    "private": "\ue000\U000f0000",
    "assignment": "a\nWATCHDOG=trigger\nMAINPID=1",
    "markup": '<img src=x onerror="alert(1)">',
    "long": "x" * 255,
    "long and escaped": "\x1b" * 255,
}


def unprintable(text: str) -> list[str]:
    """The characters of a page or log that do more than show; a line break is none of them."""
    return [letter for letter in text if letter != "\n" and not letter.isprintable()]
