"""Recalibration of a model with a few new rows, and movements since the model was made."""
