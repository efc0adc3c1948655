"""Initial guesses of bases, tools, sockets and anchors, which the user therefore need not state."""
