"""Initial guesses of bases, tools, sockets and anchors, so that the user need not give any."""
