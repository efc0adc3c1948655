"""`pisigma fleet`: many robots with one command."""
