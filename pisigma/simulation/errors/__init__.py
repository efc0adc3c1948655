"""Error sources: differences of a true robot from the nominal one, one file each."""
