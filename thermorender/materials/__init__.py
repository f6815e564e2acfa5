"""Materials: emissivity by wavelength and angle and thermal properties, from editable tables."""
