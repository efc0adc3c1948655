"""Features and weights of the joint correction, which is fitted through the kinematics."""
