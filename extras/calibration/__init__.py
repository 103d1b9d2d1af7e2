"""The calibration of a camera: the board that is printed, what photographs of it tell, the file that capture reads."""
