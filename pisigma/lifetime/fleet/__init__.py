"""Fleets: robots and their sessions, results, status and fleet priors."""
