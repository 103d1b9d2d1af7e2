"""What a process is before it becomes its command: `python launch.py DRIVER CORES COMMAND ...`, such as 0,1 for CORES.

It ends when its driver ends, however that does; it works on its cores; and where memory runs out, the system ends it,
not the driver. It is run by its path and imports the standard library alone, so that it takes no time.
"""

import contextlib
import ctypes
import os
import signal
import sys

_SET_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of linux/prctl.h
_RATHER_THAN_OTHERS = "500"  # of -1000 to 1000: how gladly the system ends a process when memory runs out
CANNOT_RUN = 127  # as of a shell


def main() -> None:
    driver, cores, command = int(sys.argv[1]), set(map(int, sys.argv[2].split(","))), sys.argv[3:]
    end_with(driver)
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
        file.write(_RATHER_THAN_OTHERS)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)
    try:
        os.execvp(command[0], command)
    except OSError as error:
        sys.stderr.write(f"splatnode: {command[0]} cannot be run: {error.strerror}\n")
        sys.exit(CANNOT_RUN)


def end_with(driver: int) -> None:
    """Has the system end this process when its parent `driver`, a process's number, ends; now, if it has."""
    with contextlib.suppress(AttributeError):  # where the system is not Linux
        ctypes.CDLL(None).prctl(_SET_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != driver:
        sys.exit("the driver has ended")


if __name__ == "__main__":
    main()
