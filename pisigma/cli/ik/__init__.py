"""`pisigma ik`: the command, and how solutions are printed and written."""
