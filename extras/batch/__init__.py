"""Many recordings, each reconstructed by a process of its own; what fails costs only itself.

`batch` finds the recordings, runs their commands, and writes down each end as it comes; `remote` runs them on a Ray
cluster; `report` shows them all and takes their cameras back to the recordings; `command` is the verb. It runs without
torch.
"""
