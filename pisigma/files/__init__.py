"""Read and write files, with inputs of limited size, outputs that are complete or absent, and located errors."""
