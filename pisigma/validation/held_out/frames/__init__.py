"""Frames of measured rows: fitted to them in closed form, and errors under such frames."""
