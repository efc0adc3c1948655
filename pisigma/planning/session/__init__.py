"""Measuring sessions: judgement of rows as they arrive, accuracy so far, and when to stop."""
