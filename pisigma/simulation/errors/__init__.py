"""Error sources: what makes a true robot differ from the nominal one, one file each."""
