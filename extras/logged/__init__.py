"""What robots log: pictures, depth, calibrations and transforms, of Foxglove's schemas and of ROS 2, in MCAP files.

`mcap` reads the file, `messages` its messages by their schemas, `transforms` the places of cameras and robot. All of it
is a stranger's: what cannot be read raises UnusableLog or UnusableMessage.
"""
