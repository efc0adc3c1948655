"""Read and write files: inputs of limited size, outputs that are complete or absent, errors with file and line."""
