"""Frames that are fitted to measured rows, and errors of rows in such frames."""
