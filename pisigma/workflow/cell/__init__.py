"""Calibration steps on a cell: its file, its sessions and its models."""
