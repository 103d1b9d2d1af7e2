"""Work in processes of its own, some at a time: on cores of this machine, or on a Ray cluster. It runs without torch.

`calls` has one process with its limits, or some of them at a time, and runs functions of values in processes; on this
machine these are copies of one that has imported what they need, the `template`; `ray` moves functions of values to a
cluster. None of them knows what the work is.
"""
