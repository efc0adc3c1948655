"""Conversion of exports of instruments and controllers to measurement files."""
