"""State of a cell, which is one robot on its mount: sessions, events, models, and the model in use."""
