"""Engines of calls for tests: in this process, which starts none."""

from __future__ import annotations

import io
import pickle
from collections.abc import Generator
from pathlib import Path
from typing import Any

from splatnode.extras.jobs import NOT_RUN, Answer, Engine, Limits, Take, usable_cores
from splatnode.extras.jobs.template import module_of


def in_this_process(cores_each: int | None = None) -> Engine:
    """An engine that makes one call after the other, and reports what it raises; it says that each has `cores_each`."""
    return Engine(cores_each or len(usable_cores()), _answers)


def _answers(take: Take, _: Limits, folder: Path) -> Generator[tuple[Any, Answer], None, None]:
    while (task := take()) is not None:
        try:
            call = io.BytesIO(task.call)
            module_of(call)
            answer = Answer(pickle.dumps(pickle.load(call)()), "", NOT_RUN)
        except Exception as error:
            answer = Answer(None, str(error), NOT_RUN)
        yield task.about, answer
