"""How a visible and a thermal camera that are fixed to each other see the same ground: found from their pictures."""
