"""Read and write files: inputs are limited in size, outputs are complete or absent, and errors state their place."""
