"""Corrected targets as a table and as programs for robot controllers."""
