"""A calibrated model and few new rows: what has moved since, and the model that holds again."""
