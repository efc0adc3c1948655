"""Many robots at once: which there are, what is worked out for each and where, and what came of it."""
