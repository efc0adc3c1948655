"""Rewriting of pose targets in existing controller programs; other parts of the programs do not change."""
