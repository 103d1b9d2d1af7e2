"""LeRobot's data sets of version 3.0: episodes whose videos lie one behind the other in shared files.

`data_set` finds the episodes and cameras, `pyarrow` reads the tables. Source: LeRobot, `dataset_metadata.py` and
`utils.py` of its datasets, codebase version v3.0.
"""
