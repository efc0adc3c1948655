"""Rewriting of pose targets in existing programs of controllers; other parts of the programs do not change."""
