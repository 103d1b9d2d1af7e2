"""An adversary who has read the code: structured cases for every boundary, drawn from the grammar of what it reads.

edges.py has the numbers and texts at which readers go wrong, schema_values.py draws values from a message's own schema,
and the other files write one kind of input each: messages, images, scenes, cameras, documents (JSON and YAML) and
stored files. boundaries.py is the table of what reads them. Everything is drawn from a `random.Random`, so that a seed,
hypothesis or atheris can choose.
"""
