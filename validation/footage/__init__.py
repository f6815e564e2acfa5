"""Power spectra and noise of simulated and of real frames."""
