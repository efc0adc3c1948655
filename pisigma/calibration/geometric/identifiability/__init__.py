"""What the data can and cannot determine."""
