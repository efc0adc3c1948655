"""`pisigma measure`: the command, its lines on a terminal, and its page in the browser."""
