"""Existing programs of controllers whose pose targets are rewritten; everything else in them is unchanged."""
