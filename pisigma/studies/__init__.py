"""What only reproduces the papers."""
