"""Reading and writing files: bounded inputs, outputs that are complete or absent, and errors with file and line."""
