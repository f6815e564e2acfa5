"""Materials: what a surface emits and reflects by wavelength and angle, from tables people edit."""
