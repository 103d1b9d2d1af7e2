"""The system that a process runs on: the service manager, shortages, signals, limits, and strangers who wait."""

from __future__ import annotations

import collections
import contextlib
import ctypes
import errno
import functools
import ipaddress
import logging
import math
import os
import re
import resource
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TypeVar

from splatnode.capture.process.text import sanitize_text

# systemd's notification protocol (sd_notify(3)): ready, alive, stopping. Without systemd nothing happens.

WATCHDOG_SHARE = 0.25  # of the watchdog's time between two signs of life; sd_watchdog_enabled(3) asks for half at most


class ServiceManager:
    """Tells systemd that the process is ready, alive or stopping. `alive` may be called often and limits its rate."""

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        usec = os.environ.get("WATCHDOG_USEC", "")
        timeout_s = int(usec) / 1e6 if re.fullmatch("[0-9]{1,18}", usec) else 0.0
        self._every_s = WATCHDOG_SHARE * timeout_s if timeout_s else 1.0
        self._next = 0.0
        self._is_ready = self._knows_ready = False

    @property
    def is_ready(self) -> bool:
        return self._is_ready

    def ready(self) -> None:
        """Only the first call sends; `alive` goes on with that until it has gone out."""
        if not self._is_ready:
            self._is_ready = True
            self._knows_ready = self._notify("READY=1")

    def alive(self, status: str) -> None:
        """`status` is shown by systemctl status."""
        if self._is_ready and not self._knows_ready:
            self._knows_ready = self._notify("READY=1")
        # A line break would begin another assignment.
        if time.monotonic() >= self._next and self._notify(f"WATCHDOG=1\nSTATUS={sanitize_text(status)}"):
            self._next = time.monotonic() + self._every_s

    def stopping(self) -> None:
        self._notify("STOPPING=1")

    def _notify(self, message: str) -> bool:
        """False where it is worth another time: the manager is busy, or this process has no descriptor to spare."""
        if not self._address:
            return True
        address = f"\0{self._address[1:]}" if self._address.startswith("@") else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as link:
                link.sendto(message.encode(), address)
        except (FileNotFoundError, ConnectionRefusedError):
            self._address = ""  # a manager that does not listen is none
        except OSError:
            return False
        return True


# What the system lets this process have. libzmq ends a process, without an exception, that has no more of it.


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
    """Raises LimitTooLow where so many further files cannot be opened, or so many threads not be started."""
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


# The memory of this process: how much it has, and that malloc keeps what was freed.
#
# Without keeping it, the kernel takes the pages of each frame back and zeroes them anew for the next one. Measured
# with 30 frames of 720p a second: a quarter of what the process costs besides decoding.

log = logging.getLogger(__name__)

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_LARGEST = 64 << 20  # bytes; larger arrays come from the kernel and go back to it. A frame of 20 megapixels is smaller


def keep_freed() -> None:
    """Has malloc keep freed memory; where the C library is not glibc, nothing changes."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGEST)
        mallopt(_M_TRIM_THRESHOLD, 2 * _LARGEST)


def resident_mb() -> float:
    """Resident memory of this process now, in 2^20 bytes; 0 where that cannot be read, which is said once.

    Heartbeats tell of it: where no file can be opened, they have the more to come.
    """
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    except (OSError, MemoryError, ValueError, IndexError) as error:
        _say_unknown(f"{type(error).__name__}: {error}")
        return 0.0


@functools.cache
def _say_unknown(why: str) -> None:
    log.warning("how much memory this process has cannot be read (%s): 0 MB is told", why)


# Errors for want of memory, threads or open files, whoever asked for them: no fault of what was worked on.


SHORT_OF_MEMORY = (
    "the memory, the threads or the open files that this process may have do not suffice: end others, or raise its "
    "limits"
)
_OF_FILES = {errno.EMFILE, errno.ENFILE}  # no descriptor is free, in this process or on the whole machine
_OF_PROCESS = _OF_FILES | {errno.ENOMEM}
# PyTorch and OpenCV have no exception of their own for it.
_OF_LIBRARIES = re.compile(
    r"can't allocate memory|not enough memory|Insufficient memory|Failed to allocate|bad_alloc|can't start new thread",
    re.IGNORECASE,
)
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.05, 2.0  # before it is tried again; doubled each time
_FILES_S, _MEMORY_S = 600.0, 10.0  # of trying. Files come back when others close theirs; what lacks memory rarely fits
_MOST_CAUSES = 10  # errors that one error has as its causes

T = TypeVar("T")


def is_shortage(error: BaseException) -> bool:
    """Whether something failed for want of memory, threads or files; of files, too, where that is the cause of `error`.

    That says nothing of what it was done with: neither a file nor its sender is to blame, and another time may do.
    """
    return _lacks_memory(error) or any(_code(each) in _OF_PROCESS for each in _list_causes(error))


def may_be_shortage(error: BaseException) -> bool:
    """As `is_shortage`, and where memory lacked for what a stranger's bytes describe: perhaps he asks for too much."""
    return is_shortage(error) or any(map(_lacks_memory, _list_causes(error)))


def raise_shortage(error: BaseException) -> None:
    """Raises `error` where it is a shortage; for code that would else hold what it worked on to be broken."""
    if is_shortage(error):
        raise error


def outlast(work: Callable[[], T], what: str, files_s: float = _FILES_S) -> T:
    """Returns what `work` does, which is repeated while this process is short of something; that is said once.

    `what` is waiting, in the words of a person. Raises the shortage where that lasts for too long: for want of files
    `files_s`, for want of memory less.
    """
    began, pause_s = time.monotonic(), _FIRST_PAUSE_S
    while True:
        try:
            return work()
        except Exception as error:
            patience_s = files_s if _lacks_files(error) else min(files_s, _MEMORY_S)
            if not may_be_shortage(error) or time.monotonic() - began > patience_s:
                raise
            if pause_s == _FIRST_PAUSE_S:
                log.warning("%s has to wait: %s", what, SHORT_OF_MEMORY)
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)


def _lacks_memory(error: BaseException) -> bool:
    if isinstance(error, (OSError, ValueError)):  # what a ValueError says may be a stranger's words
        return False
    return isinstance(error, MemoryError) or bool(_OF_LIBRARIES.search(str(error)))


def _lacks_files(error: BaseException) -> bool:
    return any(_code(each) in _OF_FILES for each in _list_causes(error))


def _code(error: BaseException) -> int | None:
    """Returns the system's error number; ZeroMQ's and FFmpeg's errors have one, too."""
    return getattr(error, "errno", None)


def _list_causes(error: BaseException) -> list[BaseException]:
    found, cause = [error], error.__cause__
    while cause is not None and len(found) < _MOST_CAUSES:
        found.append(cause)
        cause = cause.__cause__
    return found


# Which package brings a module that cannot be imported, and which extra of splatnode's brings that package.

# Import name -> distribution. An installation brings them all.
REQUIRED = {
    "av": "av",
    "cv2": "opencv-contrib-python-headless",
    "msgspec": "msgspec",
    "numpy": "numpy",
    "scipy": "scipy",
    "torch": "torch",
    "yaml": "pyyaml",
    "zmq": "pyzmq",
}
# Import name -> the extra that brings the package of that name.
EXTRAS = {
    "PIL": "heic",
    "depthai": "oak",
    "gsplat": "cuda",
    "matplotlib": "bench",
    "mcap": "mcap",
    "onnxruntime": "xfeat",
    "open3d": "viewer",
    "pi_heif": "heic",
    "pyarrow": "batch",
    "pycolmap": "bench",
    "ray": "ray",
    "rerun": "rerun",
    "safetensors": "learned",
    "viser": "viser",
}


def remedy(module: str) -> str:
    """Says what to run where `module`, or a part of it, is missing."""
    name = module.split(".")[0]
    if name in EXTRAS:
        return f"Run: pip install 'splatnode[{EXTRAS[name]}]'"
    lacking = f"Run: pip install {REQUIRED[name]}. Or write" if name in REQUIRED else "Write"
    return f"The installation is not complete. {lacking} ./run in place of splatnode, which installs what it needs"


# What a daemon's failure means to who started it: before it was ready, and after.

_HELPED_BY_A_START = (69, 75)  # exit codes: the camera is not there, another process is still ending


class FailedAfterReady(RuntimeError):
    """A process failed after it was ready: no fault of its configuration, and another start may help."""

    exit_code = 70


@contextlib.contextmanager
def wrap_late_errors(manager: ServiceManager) -> Iterator[None]:
    """Once the process is ready, an error in here is no longer one of its configuration, whatever it was raised for.

    The exit codes that the units take as the call for a human, 2 and 77, are those of a start that failed.
    """
    try:
        yield
    except Exception as error:
        helped = is_shortage(error) or getattr(error, "exit_code", None) in _HELPED_BY_A_START
        if not manager.is_ready or helped:
            raise
        raise FailedAfterReady(f"{type(error).__name__}: {error}") from error


# The first signal stops a process cleanly, the second ends it at once: what it writes is whole or not there.

_REPEATED_S = 0.5  # a signal that comes again sooner is the same one: timeout(1) sends each twice


def handle_first_signal(numbers: tuple[signal.Signals, ...], stop: Callable[[], object]) -> None:
    """Calls `stop` at the first of these signals; the second does what it does to any process."""
    first_s = math.inf

    def handle(number: int, _frame: object) -> None:
        nonlocal first_s
        if first_s == math.inf:
            first_s = time.monotonic()
            stop()
        elif time.monotonic() - first_s > _REPEATED_S:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)

    for number in numbers:
        signal.signal(number, handle)


# Strangers who wait for a place: whose turn it is to go, so that one machine's crowd takes nothing from another's.

_NETWORK_BITS = 64  # of an IPv6 address: one network has all that follow

Place = TypeVar("Place")


def network_of(host: str) -> str:
    """The machine, or the IPv6 network, that a numeric address belongs to. Raises ValueError."""
    address = ipaddress.ip_address(host.partition("%")[0])
    if address.version == 4:
        return str(address)
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.ip_network((int(address), _NETWORK_BITS), strict=False))


def next_to_go(networks: Mapping[Place, str]) -> Place:
    """The oldest place, which comes first, of the network that has the most. Raises ValueError where there is none."""
    crowd = max(collections.Counter(networks.values()).items(), key=lambda each: each[1])[0]
    return next(place for place, network in networks.items() if network == crowd)
