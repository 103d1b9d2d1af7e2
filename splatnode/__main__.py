"""`python -m splatnode VERB`."""

import sys

from splatnode.command_line import main

if __name__ == "__main__":
    sys.exit(main())
