"""What robots log: image topics and their calibrations, of Foxglove's schemas and of ROS 2, in MCAP files.

`mcap` reads the file, `foxglove` and `ros2` its messages by their schemas, `protobuf` and `cdr` their bytes; `pixels`
makes pictures of raw images and `calibration` finds the lens of a topic. All of it is a stranger's: what cannot be read
raises UnusableLog or UnusableMessage.
"""
