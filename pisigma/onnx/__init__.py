"""ONNX graphs, node by node, and the parts of them that several layers use."""
