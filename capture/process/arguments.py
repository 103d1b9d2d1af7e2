"""The kinds of values that arguments of the command line take, each with a message for a wrong one."""

from __future__ import annotations

import argparse
import gc
import ipaddress
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

from splatnode.capture.process.terminal import show_waiting
from splatnode.capture.process.text import MAX_NUMBER, sanitize_text

_MAX_DIGITS = 20
_LAST_PORT = 65535


def _whole_number(least: int) -> Callable[[str], int]:
    def convert(text: str) -> int:
        number = int(text) if text.strip().isdecimal() and len(text) <= _MAX_DIGITS else -1
        if not least <= number <= MAX_NUMBER:
            raise argparse.ArgumentTypeError(
                f"must be a whole number from {least} to {MAX_NUMBER}; got {_quote_text(text)}"
            )
        return number

    return convert


positive, natural = _whole_number(1), _whole_number(0)


def port(text: str) -> int:
    """The number of a port, from 0 to 65535."""
    number = natural(text)
    if number > _LAST_PORT:
        raise argparse.ArgumentTypeError(
            f"must be the number of a port, from 0 to {_LAST_PORT}; got {_quote_text(text)}"
        )
    return number


def address(text: str) -> str:
    """The numeric address of a machine, IPv4 or IPv6: no name is looked up."""
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"must be a numeric address, as 192.168.1.5; got {_quote_text(text)}"
        ) from None


def seconds(text: str) -> float:
    """A time in seconds, above 0."""
    return _above_zero(text, "seconds")


def megabytes(text: str) -> float:
    """A size in 10^6 bytes, above 0."""
    return _above_zero(text, "megabytes")


def millimetres(text: str) -> float:
    """A length in millimetres, above 0."""
    return _above_zero(text, "millimetres")


def length(text: str) -> float:
    """A length in the unit of a result, above 0."""
    return _above_zero(text, "units of length")


def percent(text: str) -> float:
    """A share in percent, above 0."""
    return _above_zero(text, "percent")


def angle(text: str) -> float:
    """Degrees of an angle of view."""
    degrees = _above_zero(text, "degrees")
    if degrees >= 180.0:
        raise argparse.ArgumentTypeError(f"must be below 180 degrees, got {_quote_text(text)}")
    return degrees


def _above_zero(text: str, unit: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number <= MAX_NUMBER:
        raise argparse.ArgumentTypeError(
            f"must be a number of {unit} above 0, up to {MAX_NUMBER}; got {_quote_text(text)}"
        )
    return number


def names(text: str) -> tuple[str, ...]:
    """Values with commas between them: a,b,c."""
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise argparse.ArgumentTypeError(f"must be values with commas between them; got {_quote_text(text)}")
    return names


def size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT in pixels."""
    sides = [int(side) for side in text.split("x") if side.isdecimal() and len(side) <= _MAX_DIGITS]
    if len(sides) != 2 or not 16 <= min(sides) <= max(sides) <= 4096:
        raise argparse.ArgumentTypeError(f"must be WIDTHxHEIGHT, from 16 to 4096 pixels; got {_quote_text(text)}")
    return sides[0], sides[1]


def box(text: str) -> tuple[float, float, float, float, float, float]:
    """x0,y0,z0,x1,y1,z1: the corners of a box, the first below the second on each axis."""
    try:
        x0, y0, z0, x1, y1, z1 = (float(number) for number in text.split(","))
    except ValueError:
        x0, y0, z0, x1, y1, z1 = [math.nan] * 6
    if not all(math.isfinite(number) and abs(number) <= MAX_NUMBER for number in (x0, y0, z0, x1, y1, z1)):
        raise argparse.ArgumentTypeError(f"must be six numbers with commas between them; got {_quote_text(text)}")
    for axis, least, most in (("x", x0, x1), ("y", y0, y1), ("z", z0, z1)):
        if least >= most:
            raise argparse.ArgumentTypeError(f"must have {axis}0 below {axis}1; got {_quote_text(text)}")
    return x0, y0, z0, x1, y1, z1


def counts(text: str) -> tuple[int, ...]:
    """Whole numbers above 0 with commas between them: 3,6,12."""
    return tuple(positive(name) for name in names(text))


def add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object for programs")


def _quote_text(text: str) -> str:
    return repr(sanitize_text(text, 100))


# A verb of the command line. Each room lists its own in `verbs.py`, which loads nothing that takes time.

Command = Callable[[argparse.Namespace], int]  # returns the exit code


@dataclass(frozen=True)
class Verb:
    name: str
    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Command


def replace_former_words(
    argv: Sequence[str], verbs: Mapping[str, str], flags: Mapping[str, Mapping[str, str]]
) -> tuple[list[str], list[str]]:
    """Returns a command line by the present names of its verb and flags, and a sentence for each former one.

    `verbs` and, for each verb, `flags` give the present names by the former ones. What follows `--` stays.
    """
    if not argv:
        return [], []
    verb = verbs.get(argv[0], argv[0])
    end = argv.index("--") if "--" in argv else len(argv)
    words, of_verb = [verb], flags.get(verb, {})
    for word in argv[1:end]:
        flag, equals, value = word.partition("=")
        words.append(of_verb.get(flag, flag) + equals + value)
    replacements = {old: new for old, new in zip(argv, words, strict=False) if old != new}
    sentences = [
        f"{old.partition('=')[0]} is called {new.partition('=')[0]} now; the former name is read in this release only"
        for old, new in replacements.items()
    ]
    return [*words, *argv[max(1, end) :]], sentences


def import_lazily(module: str, function: str) -> Command:
    """`function` of `module`, which is imported when the verb runs and not before."""

    def run(args: argparse.Namespace) -> int:
        return getattr(_load_module(module), function)(args)

    return run


def _load_module(module: str) -> ModuleType:
    """The module, without the collector, which would walk through all that torch brings again and again meanwhile.

    What is there then stays as long as the process, so that no later collection walks through it either.
    """
    gc.disable()
    try:
        with show_waiting("loading splatnode"):
            return import_module(module)
    finally:
        gc.freeze()
        gc.enable()
