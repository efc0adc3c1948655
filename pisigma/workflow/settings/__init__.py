"""Settings of the workflow's steps; they import without torch, so that command lines start at once."""
