"""Physics of heat and radiation as pure NumPy functions: spectra, sun, sky, surfaces and the heat of the ground."""
