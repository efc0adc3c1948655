"""The geometric calibrator: base and tool, parameters, least squares, redundancy, result."""
