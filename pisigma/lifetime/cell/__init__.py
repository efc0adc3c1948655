"""State of a cell, one robot on its mount: its sessions, events and models, and the model in use."""
