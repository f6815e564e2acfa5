"""A desert wadi by drone: the heat balance with a stated albedo against a thermal map."""
