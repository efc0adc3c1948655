"""Identifiability: which parameters the data determine, and whether a fit is plausible."""
