"""Many recordings, each reconstructed by a process of its own; what fails costs only itself.

`batch` finds the recordings, runs their commands, here or on a Ray cluster, and writes down each end as it comes;
`command` is the verb: it shows them all, and takes their cameras back to the recordings. It runs without torch.
"""
