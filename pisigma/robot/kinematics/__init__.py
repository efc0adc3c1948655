"""Forward kinematics, Jacobians and inverse kinematics of serial robots."""
