"""What the system lets this process have. libzmq ends a process, without an exception, that has no more of it."""

from __future__ import annotations

import os
import resource
import threading


class LimitTooLow(RuntimeError):
    """The process may not have what it needs; the text says of what and how to raise the limit."""

    exit_code = 75


def raise_file_limit() -> None:
    """Lets the process have as many open files as the system allows it.

    Every connection takes one, even that of a client that is refused, until its handshake fails. Without one left,
    no file can be written and libzmq aborts the process.
    """
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def make_sure_of_room(files: int, threads: int) -> None:
    """Raises Limited where so many further files cannot be opened, or so many threads not be started."""
    now, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        used = len(os.listdir("/proc/self/fd"))
    except OSError:  # there is not even one for the folder, or it is not Linux
        used = 0 if not os.path.isdir("/proc/self/fd") else now
    if now != resource.RLIM_INFINITY and now - used < files:
        raise LimitTooLow(
            f"this process may have {now} open files, has {used}, and needs {files} more. "
            "Raise the limit: ulimit -n, or LimitNOFILE= of the service"
        )
    started: list[threading.Thread] = []
    done = threading.Event()
    try:
        for _ in range(threads):
            started.append(threading.Thread(target=done.wait))
            started[-1].start()
    except RuntimeError as error:
        raise LimitTooLow(
            f"this process could start {len(started) - 1} further threads, and needs {threads}. "
            "Raise the limit: ulimit -u, or TasksMax= of the service"
        ) from error
    finally:
        done.set()
        for thread in started:
            if thread.ident is not None:
                thread.join()
