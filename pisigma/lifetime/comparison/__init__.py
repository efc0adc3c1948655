"""Comparison of two models of one robot: parameters, tool positions, and programs taught with either of them."""
