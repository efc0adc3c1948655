"""Two models of one robot beside each other: parameters, tool positions, and programs taught with one of them."""
