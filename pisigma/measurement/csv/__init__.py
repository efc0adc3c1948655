"""Measurement files: read, checked and written."""
