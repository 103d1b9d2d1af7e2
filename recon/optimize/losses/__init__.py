"""What the optimiser may minimise besides the photometric loss: one file an equation of the paper."""
