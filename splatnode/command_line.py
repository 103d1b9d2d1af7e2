"""The command line. Each room lists its verbs in its `verbs.py`; the rest of a room is imported when one of them runs.

Further verbs are entry points of `splatnode.verbs`, as those of the room `extras` are.

Exit codes: 0 good; 2 usage or configuration; 65 the photographs give no scene, or no lens (the text says why);
69 camera or package unavailable; 70 internal; 73, 74 cannot write; 75 try again; 77 not allowed; 130 interrupted;
141 nobody reads what is printed any more, as after `| head`.
A daemon that has been ready ends with none of 2 and 77: what fails then is no fault of its configuration.
SIGTERM is a clean stop with 0; the second one ends the process at once.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import faulthandler
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Sequence
from typing import Any, NoReturn

import splatnode.capture.verbs
import splatnode.recon.verbs
import splatnode.viewer.verbs
from splatnode.capture.process import former_names, plugins
from splatnode.capture.process.arguments import Verb, replace_former_words
from splatnode.capture.process.files import default_runtime_directory
from splatnode.capture.process.library_lines import keep_last_words, tell_last_words
from splatnode.capture.process.system import SHORT_OF_MEMORY, handle_first_signal, is_shortage, remedy
from splatnode.capture.process.terminal import beneath, is_output_closed, sanitize_output, say, use_plain_lines
from splatnode.capture.process.text import sanitize_lines, sanitize_text

# libgomp's threads spin while they wait. On a robot's busy processor that doubles the time of torch's operations.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# So do OpenBLAS's, over matrices of three columns that one thread is through with before the others wake.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# What OpenCV warns of, a damaged photograph, is said with the name of that photograph.
# Its lines have what a stranger's file says, which its exceptions say, too.
os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")

_NOBODY_READS = 128 + signal.SIGPIPE  # as a shell says of a program that a closed pipe ended

# Of the core; further ones are entry points.
VERBS = (*splatnode.recon.verbs.VERBS, *splatnode.viewer.verbs.VERBS, *splatnode.capture.verbs.VERBS)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the verb that `argv` names and returns the exit code. Raises SystemExit for usage errors and SIGTERM."""
    with sanitize_output():
        return _run(argv)


def _run(argv: Sequence[str] | None) -> int:
    words, sentences = replace_former_words(
        sys.argv[1:] if argv is None else argv, former_names.VERBS, former_names.FLAGS
    )
    for sentence in sentences:
        say(f"splatnode: {sentence}", error=True)
    parser = build_parser(words[0] if words else None)
    args = parser.parse_args(words)
    if args.verb is None:
        parser.print_help(sys.stderr)
        return 2
    use_plain_lines()
    logging.getLogger("splatnode").setLevel(logging.DEBUG if args.debug else logging.INFO)
    _prepare_for_crash()
    stopping = threading.Event()

    def stop() -> None:
        stopping.set()
        sys.exit(0)

    handle_first_signal((signal.SIGTERM,), stop)
    try:
        code = args.run(args)
        print(end="", flush=True)  # where there is a standard output
        return code
    except (Exception, KeyboardInterrupt) as error:
        if isinstance(error, BrokenPipeError) and is_output_closed():
            return _NOBODY_READS
        if stopping.is_set():  # a package that was being imported makes an ImportError of the exit
            return 0
        if args.debug:
            print(sanitize_lines(traceback.format_exc()), file=sys.stderr)
        code = exit_code(error)
        print(f"splatnode: {explain(error, code)}", file=sys.stderr)
        return code


def _prepare_for_crash() -> None:
    """A crash in a library shows on standard error where it was, and what is said before it can be found afterwards."""
    if not faulthandler.is_enabled():  # whoever has enabled it knows where it is to be told
        with contextlib.suppress(OSError, ValueError, AttributeError, RuntimeError):  # there is no such descriptor
            faulthandler.enable(beneath(sys.stderr))
    tell_last_words(default_runtime_directory())
    keep_last_words(default_runtime_directory())


class _Parser(argparse.ArgumentParser):
    """One whose complaints repeat an argument as text that only shows."""

    def error(self, message: str) -> NoReturn:
        super().error(sanitize_lines(message))


def list_verbs() -> tuple[Verb, ...]:
    """All verbs: those of the core, whose names no other has, then those that are installed beside it."""
    own = {verb.name for verb in VERBS}
    further = {verb.name: verb for verb in plugins.load_all(plugins.VERBS, _try_verb).values()}
    return *VERBS, *(verb for name, verb in further.items() if name not in own)


def build_parser(wanted: str | None = None) -> argparse.ArgumentParser:
    """Returns the parser of all verbs, or of the core's verb `wanted` alone, for which nothing else is loaded."""
    parser = _Parser(
        prog="splatnode",
        description="Photographs in, camera poses and a 3D Gaussian scene out, on a CPU.",
        allow_abbrev=False,
    )
    parser.set_defaults(verb=None)
    verbs = parser.add_subparsers(metavar="VERB")
    for verb in [verb for verb in VERBS if verb.name == wanted] or list_verbs():
        subparser = _add_verb(verbs, verb)
        subparser.add_argument(
            "--debug", action="store_true", help="show the traceback of an error, and all that is logged"
        )
        subparser.set_defaults(verb=verb.name, run=verb.run)
    return parser


def _add_verb(verbs: Any, verb: Verb) -> argparse.ArgumentParser:
    subparser = verbs.add_parser(verb.name, help=verb.summary, description=verb.summary, allow_abbrev=False)
    verb.add_arguments(subparser)
    return subparser


def _try_verb(verb: Verb) -> None:
    """Raises what a verb of another package fails with when it is offered."""
    parser = argparse.ArgumentParser()
    subparser = _add_verb(parser.add_subparsers(), verb)
    parser.format_help()
    subparser.format_help()


def exit_code(error: BaseException) -> int:
    """Returns the exit code of an exception that ended a verb. Rooms raise ValueError for what the user can put right.

    An exception of a room that knows better has an `exit_code` of its own.
    """
    if isinstance(error, KeyboardInterrupt):
        return 130
    if (own := getattr(error, "exit_code", None)) is not None:
        return own
    if is_shortage(error):
        return 75
    if isinstance(error, OSError):
        return _os_exit_code(error)
    if isinstance(error, ModuleNotFoundError):
        return 69
    return 2 if isinstance(error, ValueError) else 70


def explain(error: BaseException, code: int) -> str:
    """One line, or the error's own text where that has more, its further lines set in."""
    return sanitize_lines(_describe_error(error, code))


def _describe_error(error: BaseException, code: int) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    if is_shortage(error):
        return f"{SHORT_OF_MEMORY} ({type(error).__name__})"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror if error.filename is None else f"{error.strerror}: {_file(error.filename)}"
    if isinstance(error, ModuleNotFoundError):
        return f"{error}. {remedy(error.name or '')}"
    if code == 70:
        return f"internal error: {type(error).__name__}: {error} (--debug shows where; splatnode doctor may tell why)"
    return str(error)


def _file(name: str | bytes | int) -> str:
    return sanitize_text(os.fsdecode(name) if isinstance(name, bytes) else name)


def _os_exit_code(error: OSError) -> int:
    if _is_write_error(error):
        no_room = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EPIPE}
        return 74 if error.errno in no_room else 73
    if isinstance(error, (FileNotFoundError, NotADirectoryError, IsADirectoryError)):
        return 2
    return 77 if isinstance(error, PermissionError) else 74


def _is_write_error(error: OSError) -> bool:
    """ResultWriteError can only have been raised by a room that has been imported."""
    staged = sys.modules.get("splatnode.recon.result.export.staged")
    return staged is not None and isinstance(error, staged.ResultWriteError)
