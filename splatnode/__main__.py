"""`python -m splatnode VERB`.

`python -m` puts the current folder before all other places of modules; a folder of photographs may hold a numpy.py.
What was imported before these lines came from there if it lay there: `splatnode VERB` and `python -I -m splatnode VERB`
never look there.
"""

import os
import sys

while not sys.flags.isolated and os.path.isdir(sys.path[0] or ".") and os.path.samefile(sys.path[0] or ".", "."):
    del sys.path[0]

from splatnode.command_line import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
