"""`splatnode VERB` and `python -m splatnode VERB`.

`python -m` puts the current folder before all other places of modules, and so does an empty entry of $PYTHONPATH; a
folder of photographs may hold a numpy.py. What was imported before these lines came from there if it lay there:
`python -I -m splatnode VERB` never looks there.
"""

import os
import sys

if not sys.flags.isolated:
    sys.path[:] = [each for each in sys.path if not (os.path.isdir(each or ".") and os.path.samefile(each or ".", "."))]

from splatnode.command_line import main

if __name__ == "__main__":
    sys.exit(main())
