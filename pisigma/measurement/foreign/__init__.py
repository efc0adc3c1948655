"""What instruments and controllers export, turned into measurement files."""
