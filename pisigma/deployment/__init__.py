"""Calibrated models for controllers and clients: files that other programs read, and a server."""
