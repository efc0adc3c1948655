"""Measuring session: rows judged as they arrive, the accuracy reached so far, and when to stop."""
