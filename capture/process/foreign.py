"""The boundary of a process: what a stranger wrote becomes a typed value, or that boundary's own error."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from splatnode.capture.process.printable import sanitize_text


@contextlib.contextmanager
def guard_untrusted(refusal: type[Exception], source: object = "") -> Iterator[None]:
    """Whatever fails in here is the fault of `source`, a file or a sender, and is raised as a `refusal` that names it.

    For the code that reads a stranger's bytes, and for nothing else: a parser meets what its author did not think of,
    and what it then raises (OverflowError, RecursionError, an IndexError of a library) is no error of the process.
    A refusal that is one already is left as it is, and so is an OSError: that the disk does not give the bytes is not
    the fault of what they say. Whether memory lacked, `may_be_shortage` tells of the refusal.
    """
    try:
        yield
    except (refusal, OSError):
        raise
    except Exception as error:
        where = f"{source}: " if source else ""
        raise refusal(f"{where}cannot be read ({type(error).__name__}: {sanitize_text(error)})") from error
