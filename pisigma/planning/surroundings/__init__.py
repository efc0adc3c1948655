"""The cell that a robot is measured in: which poses are free and visible, and which motions between them."""
