"""The reconstruction as a process that runs for weeks: key frames in, scenes out, nothing acknowledged lost."""
