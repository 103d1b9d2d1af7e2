"""The panel beside the picture: buttons, four tabs, and a line about what was done last."""
