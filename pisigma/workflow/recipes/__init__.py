"""Recipe files: what to train, on what."""
