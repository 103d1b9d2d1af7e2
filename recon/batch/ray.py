"""Many recordings on a Ray cluster, or on one that is begun here. Needs the extra ray.

Ray places the work, and repeats what was lost with a worker or a machine; what a recording is and how it fails is as on
one machine (`remote`). Workers send one row a recording; results go from them to the shared folder or store.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import sys
from collections.abc import Generator, Iterable, Iterator
from importlib import import_module
from typing import Any

from splatnode.capture.process.printable import printable
from splatnode.capture.process.terminal import beneath
from splatnode.recon.batch.answer import Outcome, without_answer
from splatnode.recon.batch.child import End
from splatnode.recon.batch.remote import Job, run_recording
from splatnode.recon.batch.sources import Recording

ray: Any = import_module("ray")  # by its name: where it is not installed, pyright takes this file for it
_errors: Any = import_module("ray.exceptions")

_REPEATS = 5  # of a recording whose worker or machine was lost
_WAITING = 2  # recordings that are handed over, for each core of the cluster
_WAIT_S = 1.0  # between looks at how many cores there are
_ANSWER_S = 5.0  # in which a machine answers; Ray itself tries for two minutes


class NoCluster(ConnectionError):
    """The cluster that was named cannot be reached; the text says which, and what to do."""


@contextlib.contextmanager
def joined(address: str, cores: int | None) -> Iterator[None]:
    """This process as a driver of the cluster at `address`; "": of one begun here, with `cores`. Raises NoCluster."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent to anybody
    quiet: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
    if address:
        how: dict[str, Any] = {"address": address}
    else:
        how = {"address": "local", "num_cpus": cores, "include_dashboard": False}
    try:
        _check_answers(address)
        with contextlib.redirect_stderr(beneath(sys.stderr)), contextlib.redirect_stdout(beneath(sys.stdout)):
            ray.init(**how, **quiet)  # which wants streams with descriptors
    except (OSError, ConnectionError, RuntimeError, ValueError, _errors.RayError) as error:
        where = printable(address or "this machine", 200)
        raise NoCluster(
            f"no Ray cluster can be reached at {where} ({_first_line(error)}). Start one with `ray start --head` and "
            "give the address that it prints, or give --ray without one"
        ) from error
    try:
        yield
    finally:
        ray.shutdown()


def run_all(todo: Iterable[Recording], job: Job, most: int | None) -> Generator[Outcome, None, None]:
    """The outcomes as they come, of at most `most` recordings at a time; None: of as many as the cluster has cores.

    A recording whose worker is lost is repeated elsewhere; after a few times it has failed.
    """
    run = _task(job)
    waiting, running = iter(todo), {}
    while True:
        while len(running) < _at_a_time(most) and (recording := next(waiting, None)) is not None:
            running[run.remote(recording, job)] = recording
        if not running:
            return
        for reference in ray.wait(list(running), num_returns=1, timeout=_WAIT_S)[0]:
            yield _outcome(reference, running.pop(reference))


def run_row(row: dict[str, Any], job: Job) -> dict[str, Any]:
    """A row of a dataset, which has name and source, with what came of it, column by column."""
    import msgspec

    return {**row, **msgspec.structs.asdict(run_recording(Recording(row["name"], row["source"]), job))}


def _check_answers(address: str) -> None:
    """Raises OSError where an address of a machine and a port is of none that answers."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), _ANSWER_S).close()


def _task(job: Job) -> Any:
    memory = {} if job.limits.memory_mb is None else {"memory": job.limits.memory_mb * 1e6}
    return ray.remote(run_recording).options(num_cpus=1, max_retries=_REPEATS, **memory)


def _at_a_time(most: int | None) -> int:
    """Machines may join and leave; until one is there, one recording waits for it."""
    return most or max(1, _WAITING * int(ray.cluster_resources().get("CPU", 0)))


def _outcome(reference: Any, recording: Recording) -> Outcome:
    try:
        return ray.get(reference)
    except _errors.RayTaskError as error:  # what `run_recording` raised, or why it could not be run
        reason = f"its worker could not do it: {_first_line(error.cause or error)}"
    except _errors.RayError as error:
        reason = f"its worker was lost {_REPEATS + 1} times: {_first_line(error)}"
    return without_answer(recording, End(None, "", 0.0, 0.0), reason)


def _first_line(error: BaseException) -> str:
    lines = [line for line in str(error).splitlines() if line.strip()]
    return printable(lines[0] if lines else type(error).__name__, 300)
