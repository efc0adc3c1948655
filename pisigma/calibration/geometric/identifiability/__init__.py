"""Identifiability of parameters, sufficiency of the measurements, and plausibility of a fit."""
