"""Measuring sessions: checks of rows as they arrive, accuracy so far, and advice on when to stop."""
