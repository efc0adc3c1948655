"""Error sources, one file per source: differences of a true robot from the nominal robot."""
