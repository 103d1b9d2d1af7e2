"""Video4Linux2, as much of it as a robot's camera needs: struct layouts, a device, its controls."""
