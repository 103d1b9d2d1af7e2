"""The process of a call: this module, with a folder, makes the call that lies there and answers."""

from __future__ import annotations

import os
import pickle
import sys
import traceback
from pathlib import Path
from typing import IO

from splatnode.capture.process.files import check_owner_only
from splatnode.extras.jobs.calls import ANSWER, CALL, ERROR

RAISED = 1  # the exit code where the function raised


def run_call(folder: Path) -> int:
    """Makes the call and leaves the answer, or what was raised; returns the exit code.

    Raises NotPrivate for a call that another user could have put there.
    """
    check_owner_only(folder)
    with (folder / CALL).open("rb") as call:
        module_of(call)
        try:
            answer = pickle.dumps(pickle.load(call)())
        except Exception:
            (folder / ERROR).write_text(traceback.format_exc(), errors="backslashreplace")
            return RAISED
    partial = folder / f"{ANSWER}.partial"
    partial.write_bytes(answer)
    os.replace(partial, folder / ANSWER)
    return 0


def module_of(call: IO[bytes]) -> str:
    """The name of the module of a call, which is found from here on; the function comes next in the file."""
    for place in pickle.load(call):
        if place not in sys.path:
            sys.path.append(place)
    return pickle.load(call)


if __name__ == "__main__":
    sys.exit(run_call(Path(sys.argv[1])))
