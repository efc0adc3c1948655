"""Corrected inverse kinematics compiled for one pose at a time and for batches on the CPU, without torch."""
