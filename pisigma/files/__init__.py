"""Files that come in and go out: inputs within bounds, outputs whole or not at all, and nothing lost for them."""
