"""Corrected targets as tables and as programs for robot controllers."""
