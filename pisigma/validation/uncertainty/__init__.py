"""Uncertainty of a corrected robot according to the GUM (JCGM 100:2008): components, budget and instrument."""
