"""`pisigma ik`: the command, and the output of its solutions."""
