"""The reconstruction as a process that runs for weeks: keyframes in, scenes out, nothing acknowledged lost."""
