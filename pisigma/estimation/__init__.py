"""Linear-Gaussian estimation: priors, evidence, posteriors and their update, left-out values, wrong rows and losses."""
