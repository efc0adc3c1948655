"""Several arms that measured the same objects: their models, and their bases relative to each other."""
