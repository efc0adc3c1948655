"""Measuring with a plan: rows judged as they come, what they reach so far, and when more would not help."""
