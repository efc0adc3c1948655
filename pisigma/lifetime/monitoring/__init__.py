"""Monitoring of a calibrated robot against its model, per session and over months."""
