"""Features and weights of the joint correction that is fitted through the kinematics."""
