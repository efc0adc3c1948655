"""The Pi-Sigma network and what it sees."""
