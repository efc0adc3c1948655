"""Initial guesses of bases, tools, sockets and anchors: nothing has to be guessed by the user."""
