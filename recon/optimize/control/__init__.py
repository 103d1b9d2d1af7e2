"""How the number of Gaussians changes while they are optimised: control.py is the interface, the rest is one a file."""
