"""Joint corrections, which are fitted through the kinematics: features, weights and export to ONNX."""
