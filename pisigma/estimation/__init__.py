"""The linear-Gaussian core: priors, evidence, posterior and its update, left-out and contradicting values; losses."""
