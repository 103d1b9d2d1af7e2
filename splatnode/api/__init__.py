"""What `import splatnode` gives to a program: the steps of the rooms as functions, and their results as records.

Arrays are NumPy's. Nothing is printed, but the address at which `Result.show` serves a browser; no signal is handled,
and logging is left to the program.
"""

import logging

logging.getLogger("splatnode").addHandler(logging.NullHandler())  # without it Python prints warnings of a library
