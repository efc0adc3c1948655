"""Convert exports of instruments and controllers to measurement files."""
