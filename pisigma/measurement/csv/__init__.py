"""Read, check and write measurement files."""
