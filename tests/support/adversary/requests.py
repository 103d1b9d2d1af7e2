"""What comes to the web viewer's port, and what a person may type: requests and the arguments of verbs."""

from __future__ import annotations

import random

from tests.support.adversary import edges

KEY = "k" * 43
_PATHS = ("/", "/told", "/index.html", "/page.js", "/gaussians/0", "/shapes/0", "/thumbnail/0/0", "/photograph/1/0")
_ODD_PATHS = (
    "/../../etc/passwd",
    "/gaussians/" + "9" * 4000,
    "/gaussians/١",
    "/%00",
    "/gaussians/1e3",
    "//",
    "*",
    "http://other/",
    "/told?number=%F0%9F&run=" + "a" * 3000,
    "/?key=" + "a&" * 200,
    "/thumbnail//",
    "/thumbnail/0/-1",
    "",
    "/" + "a" * 70_000,
    "/\x1b[2J",
)
_HEADERS = ("Host", "Cookie", "Authorization", "Content-Length", "Transfer-Encoding", "Connection", "Expect", "Range")
_VALUES = (
    "127.0.0.1:8347",
    "localhost",
    "evil.example",
    "[::1]:80",
    "[",
    "127.0.0.1:99999999",
    f"splatnode_8347={KEY}",
    "splatnode_8347=",
    "a=b; " * 500,
    f"Bearer {KEY}",
    "Bearer",
    "Bearer \xff\xfe",
    "-1",
    "9" * 400,
    "chunked",
    "keep-alive",
    "100-continue",
    "x" * 66_000,
    "\0",
    "a\r b",
)


def request(rng: random.Random) -> bytes:
    """In a third of the requests everything is sound."""
    odd = rng.choice((0.0, 0.1, 0.5))
    method = rng.choice(("GET",) * 6 + ("HEAD", "POST", "", "get", "G\0T", "PRI", "X" * 300)) if odd else "GET"
    path = rng.choice(_ODD_PATHS) if rng.random() < odd else rng.choice(_PATHS)
    if rng.random() < 0.4:
        path += "?" + "&".join(_question(rng) for _ in range(rng.choice((1, 2, 6))))
    version = (
        "HTTP/1.1"
        if rng.random() >= odd
        else rng.choice(("HTTP/1.0", "HTTP/0.9", "HTTP/9.9", "HTTP/", "", "HTTP/1.1.1"))
    )
    lines = [" ".join(filter(None, (method, path, version)))]
    if rng.random() >= odd / 3:
        lines.append("Host: 127.0.0.1:8347")
    for _ in range(rng.choice((0, 1, 3, 120 if rng.random() < odd / 10 else 0))):
        name = rng.choice(_HEADERS) if rng.random() >= odd / 3 else edges.text(rng)
        lines.append(f"{name}:{rng.choice((' ', ' ', '', chr(9)))}{rng.choice(_VALUES)}")
    end = "\r\n" if rng.random() >= odd / 5 else rng.choice(("\n", "\r", "\0"))
    data = (end.join(lines) + 2 * end).encode("utf-8", "surrogatepass")
    if rng.random() < odd:
        data = edges.damaged(rng, data, 1)
    return data


def _question(rng: random.Random) -> str:
    return rng.choice((f"key={KEY}", "number=0", "run=a", "number=" + edges.odd(rng, 1, 0.5), "a", "%"))


_WORDS = ("a", "photos", "10", "0.5", "3,6,12", "640x480", "100mm", "100mm@0.2mm", "0.01,2", "0,0,0,1,1,1", "b c", "-1")


def arguments(rng: random.Random, options: tuple[tuple[str, tuple[str, ...]], ...]) -> list[bytes]:
    """A command line: a verb with some of its options, and words that may be anything."""
    verb, known = rng.choice(options)
    words = [verb] if rng.random() < 0.97 else [edges.text(rng)]
    for _ in range(rng.choice((0, 1, 2, 3))):
        if known and rng.random() < 0.7:
            option = rng.choice(known)
            word = _word(rng)
            words += [f"{option}={word}"] if rng.random() < 0.2 else [option, word]
        else:
            words.append(_word(rng))
    return [word.replace("\0", "").encode("utf-8", "surrogatepass") for word in words]


def _word(rng: random.Random) -> str:
    if rng.random() < 0.5:
        return rng.choice(_WORDS)
    return (
        edges.number_text(rng)
        if rng.random() < 0.7
        else rng.choice(("\udcff", "--", "-", "=", "@", "--set", "a=b", "a.b=" + edges.number_text(rng)))
    )
