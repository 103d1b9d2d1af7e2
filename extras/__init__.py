"""What the mission does not need to run: benchmark, calibration, fleet, further cameras, priors, formats and viewers.

It plugs in by the entry points of `entry_points.txt`, beside this file. The core reads that file and imports nothing of
this room until what an entry point names is used; without the room, capture, reconstruction, node and viewer run.
"""
