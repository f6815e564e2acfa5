"""Power spectra and noise of simulated frames beside those of real ones."""
