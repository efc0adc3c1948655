"""Calibrated models for controllers and clients: files that others read, and a server."""
