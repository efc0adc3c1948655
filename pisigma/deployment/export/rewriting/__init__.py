"""Existing programs of controllers whose pose targets are rewritten; all else in them stays."""
