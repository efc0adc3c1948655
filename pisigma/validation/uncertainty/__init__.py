"""Uncertainty of a corrected robot after the GUM (JCGM 100:2008): components, their budget, and its instrument."""
