"""Studies of learned maps: what they lose with less to learn from, what training and translating cost, emissivity."""
