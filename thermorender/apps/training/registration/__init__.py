"""Registration of a visible and a thermal camera that are fixed to each other, from their pictures."""
