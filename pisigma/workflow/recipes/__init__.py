"""Recipe files, which state a model to train and its data."""
