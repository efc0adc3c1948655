"""Compiled kernels for corrected inverse kinematics of single poses and batches on the CPU, without torch."""
