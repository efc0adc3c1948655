"""Linear-Gaussian estimation: priors, evidence, posteriors and their update, held-out values, wrong rows and losses."""
