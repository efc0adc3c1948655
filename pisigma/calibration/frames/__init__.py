"""Base, tool or hand-eye transform from few rows, with the arm as given, and the causes of a bad fit."""
