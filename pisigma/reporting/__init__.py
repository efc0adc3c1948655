"""Metrics, tables, figures and cards."""
