"""What a Python process of ours does before its module: `python -I start.py FOLDERS MODULE ARGUMENT ...`.

`python` of this folder makes that command. The module is run as by `python -m`. It is run by its path and imports the
standard library alone: nothing else can be found yet.
"""

import json
import runpy
import site
import sys
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

_ROOM = Path(__file__).parents[3]  # where splatnode lies; no link is followed, since the package has links to its rooms


class _Own:
    """Finds splatnode where the process that started this one has it, whatever else is installed, and nothing else."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        return PathFinder.find_spec(name, [str(_ROOM)]) if name == "splatnode" else None


def main() -> None:
    folders, module = json.loads(sys.argv[1]), sys.argv[2]
    if (own := site.getusersitepackages()) in folders:
        folders.remove(own)
        site.addsitedir(own)
    sys.path[:0] = folders
    sys.meta_path.insert(0, _Own)
    sys.argv[:] = sys.argv[2:]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
