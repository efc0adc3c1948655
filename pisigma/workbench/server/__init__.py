"""The server of the pages: who may open them, and viser behind it."""
