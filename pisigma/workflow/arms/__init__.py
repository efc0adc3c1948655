"""Several arms that measured the same things: their models, and their bases relative to each other."""
