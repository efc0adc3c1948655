"""Many robots at once: what is done with each, what all have in common."""
