"""Base, tool or hand-eye transform from few rows with the arm held fixed, and the causes of a bad fit."""
