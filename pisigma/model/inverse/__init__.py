"""The calibrated model: geometry and network together, its folder, and corrected inverse kinematics."""
