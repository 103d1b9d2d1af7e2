"""Functions of values on a Ray cluster, or on one that is begun here. Needs the extra ray.

Ray places the work, and repeats what was lost with a worker or a machine.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import sys
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TypeVar

from splatnode.capture.process.terminal import beneath
from splatnode.capture.process.text import sanitize_text

ray: Any = import_module("ray")  # by its name: where it is not installed, pyright takes this file for it
_errors: Any = import_module("ray.exceptions")

T = TypeVar("T")
R = TypeVar("R")

_REPEATS = 5  # of a call whose worker or machine was lost
_WAITING = 2  # calls that are handed over, for each core of the cluster
_WAIT_S = 1.0  # between looks at how many cores there are
_NO_MODULES = "/"  # is there on every machine, and nobody but root puts a module there
_ANSWER_S = 5.0  # in which a machine answers; Ray itself tries for two minutes


@dataclass(frozen=True)
class LostCall:
    """A call that gave nothing, and why."""

    reason: str


class NoCluster(ConnectionError):
    """The cluster that was named cannot be reached; the text says which, and what to do."""


@contextlib.contextmanager
def join_cluster(address: str, cores: int | None) -> Iterator[None]:
    """This process as a driver of the cluster at `address`; "": of one begun here, with `cores`. Raises NoCluster.

    Ray's workers look for modules in the folder in which the driver is when it joins: not among the photographs, so.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent to anybody
    quiet: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
    if address:
        how: dict[str, Any] = {"address": address}
    else:
        how = {"address": "local", "num_cpus": cores, "include_dashboard": False}
    try:
        _check_answers(address)
        with (
            contextlib.redirect_stderr(beneath(sys.stderr)),
            contextlib.redirect_stdout(beneath(sys.stdout)),
            _change_folder(_NO_MODULES),
        ):
            ray.init(**how, **quiet)  # which wants streams with descriptors
    except Exception as error:  # a node that does not come up in time is no more than that to Ray
        where = sanitize_text(address or "this machine", 200)
        raise NoCluster(
            f"no Ray cluster can be reached at {where} ({_first_line(error)}). Start one with `ray start --head` and "
            "give the address that it prints, or give --ray without one"
        ) from error
    try:
        yield
    finally:
        ray.shutdown()


def map_on_cluster(
    take: Callable[[], T | None], function: Callable[[T], R], most: int | None, memory_mb: float | None
) -> Generator[tuple[T, R | LostCall], None, None]:
    """Yields what `take` gives, each with `function` of it from one core of a worker, as they come.

    At most `most` are under way at a time; None: as many as keep the cluster's cores busy. `take` gives None where
    there is nothing to begin now: it is asked again after each end, and all is over when nothing runs any more. A call
    whose worker is lost is repeated elsewhere; after a few times it is lost, too. `memory_mb` is what Ray sets aside
    for each.
    """
    memory = {} if memory_mb is None else {"memory": memory_mb * 1e6}
    run = ray.remote(_apply).options(num_cpus=1, max_retries=_REPEATS, **memory)
    running: dict[Any, T] = {}
    while True:
        while len(running) < _max_running(most) and (item := take()) is not None:
            running[run.remote(function, item, os.getcwd())] = item
        if not running:
            return
        for reference in ray.wait(list(running), num_returns=1, timeout=_WAIT_S)[0]:
            yield running.pop(reference), _result(reference)


def _apply(function: Callable[[T], R], item: T, folder: str) -> R:
    """In the driver's `folder`, where this machine has it: a path may be relative to that."""
    with contextlib.suppress(OSError):
        os.chdir(folder)
    return function(item)


@contextlib.contextmanager
def _change_folder(folder: str) -> Iterator[None]:
    before = os.getcwd()
    try:
        os.chdir(folder)
        yield
    finally:
        os.chdir(before)


def _check_answers(address: str) -> None:
    """Raises OSError where an address of a machine and a port is of none that answers."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), _ANSWER_S).close()


def _max_running(most: int | None) -> int:
    """Machines may join and leave; until one is there, one call waits for it."""
    return most or max(1, _WAITING * int(ray.cluster_resources().get("CPU", 0)))


def _result(reference: Any) -> Any:
    try:
        return ray.get(reference)
    except _errors.RayTaskError as error:  # what the function raised, or why it could not be run
        return LostCall(f"its worker could not do it: {_first_line(error.cause or error)}")
    except _errors.RayError as error:
        return LostCall(f"its worker was lost {_REPEATS + 1} times: {_first_line(error)}")


def _first_line(error: BaseException) -> str:
    lines = [line for line in str(error).splitlines() if line.strip()]
    return sanitize_text(lines[0] if lines else type(error).__name__, 300)
