"""Recipe files, which state what to train and on which data."""
