"""Calibrated models: predictions, domain, predicted accuracy, folders, and corrected inverse kinematics."""
