"""The Pi-Sigma network, its inputs, and its training."""
