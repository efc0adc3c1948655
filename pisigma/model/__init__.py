"""The calibrated model, its domain and its predicted accuracy."""
