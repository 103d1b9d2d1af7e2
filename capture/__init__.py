"""Cameras to frames. NumPy, OpenCV and pyzmq; never torch."""
