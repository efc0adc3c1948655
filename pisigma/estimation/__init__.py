"""The linear-Gaussian core of every estimate, and the losses of least squares."""
