"""Python in a process of its own: the one way to start it.

A data set may hold a file called numpy.py, and a program that is begun in that folder must not run it. So each process
is isolated (`-I`): the current folder is no place of modules, and neither are relative folders of $PYTHONPATH. It has
the places of an isolated Python, which are the standard library and the environment's site packages; the user's own
site packages and the absolute folders of $PYTHONPATH, where this process has them, too; and this splatnode.
"""

from __future__ import annotations

import json
import os
import site
import sys

from splatnode.capture.process import start


def command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module as `python -m` does, with these arguments, in a process that is isolated."""
    return make_isolated_command(start.__file__, json.dumps(_user_folders()), module, *arguments)


def make_isolated_command(*told: str) -> list[str]:
    """The command of an isolated Python that is `told` what to run, such as a script, or -m and a module.

    It has none of the user's places, and does not know this splatnode unless that is installed.
    """
    kept = [*(["-B"] if sys.dont_write_bytecode else []), *(["-X", "utf8"] if sys.flags.utf8_mode else [])]
    return [sys.executable, "-I", *kept, *told]  # $PYTHON... do not count there


def place_of(module: str) -> str | None:
    """The folder in which another process finds the package of a module; None for splatnode, which it finds anyway."""
    package = module.partition(".")[0]
    if package == "splatnode" or (file := getattr(sys.modules.get(package), "__file__", None)) is None:
        return None
    folder = os.path.dirname(os.path.abspath(file))
    return os.path.dirname(folder) if hasattr(sys.modules[package], "__path__") else folder


def _user_folders() -> list[str]:
    """Lists where this process finds modules because its user said so, without the current folder."""
    named = [*os.environ.get("PYTHONPATH", "").split(os.pathsep), site.getusersitepackages()]
    known = set(sys.path)
    found = dict.fromkeys(os.path.abspath(each) for each in named if os.path.isabs(each))
    return [each for each in found if each in known and not is_current_folder(each)]


def is_current_folder(folder: str) -> bool:
    """Returns whether a folder is the current one, which may be anybody's."""
    try:
        return os.path.samefile(folder, os.curdir)
    except OSError:  # one of them is not there
        return False
