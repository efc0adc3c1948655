"""Server of corrected inverse kinematics for socket clients: lines of JSON, binary frames, ZeroMQ."""
