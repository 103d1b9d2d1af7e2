"""The long adversarial campaigns, one a file, which `./run fuzz` starts by night; the tests have their short form.

A campaign is a module with `main(seconds, seed)`, which returns its counts: at least `defects`. `boundaries.py` draws
malformed input for everything that reads any, `writes.py` interrupts every write. Modules are found by their names in
`catalogue.py`.
"""
