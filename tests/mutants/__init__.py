"""Small faults that the tests must find: `python -m tests.mutants` tries each in a copy of this checkout."""
