"""`pisigma serve`: the command."""
