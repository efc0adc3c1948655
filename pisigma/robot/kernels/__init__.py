"""Compiled kernels of corrected inverse kinematics for single poses and batches on the CPU, without torch."""
