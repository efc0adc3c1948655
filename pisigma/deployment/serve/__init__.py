"""Corrected inverse kinematics for whatever can open a socket: lines of JSON, binary frames, ZeroMQ."""
