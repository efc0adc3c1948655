"""Linear-Gaussian estimation: priors, evidence, posteriors, updates, held-out errors, wrong rows and losses."""
