"""How shipped tables were made; run from a checkout, not part of the package."""
