"""Work in processes of its own, some at a time: on cores of this machine, or on a Ray cluster. It runs without torch.

`child` is one process with its limits, `engine` runs some of them at a time, and `ray` moves functions of values to a
cluster. None of them knows what the work is.
"""
