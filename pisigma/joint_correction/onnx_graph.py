"""Build an ONNX graph node by node, in double precision."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from pisigma.files.errors import missing_extra

_OPSET, _IR_VERSION = 17, 8
"""Versions of the operator set and of the file format, which runtimes of 2022 support."""

BATCH = "batch"
"""Name of the first dimension of all inputs and outputs."""

_TINY = 1e-300


def import_onnx() -> Any:
    """Import and return the optional package onnx.

    Raises:
        MissingExtraError: onnx is not installed.
    """
    try:
        import onnx
    except ImportError as problem:
        raise missing_extra(problem) or problem from None
    return onnx


class OnnxGraph:
    """Nodes, constants, inputs and outputs of a graph; values are identified by name.

    Attributes:
        nodes: nodes added so far.
        inputs: descriptions of inputs.
        outputs: descriptions of outputs.
    """

    def __init__(self) -> None:
        """Create an empty graph.

        Raises:
            MissingExtraError: onnx is not installed.
        """
        self._onnx = import_onnx()
        self.nodes: list[Any] = []
        self.inputs: list[Any] = []
        self.outputs: list[Any] = []
        self._constants: list[Any] = []

    def add_input(self, name: str, shape: Sequence[int], doc: str) -> str:
        """Declare an input `(batch, *shape)` unless it exists, and return its name."""
        if name not in {known.name for known in self.inputs}:
            self.inputs.append(self._described(name, shape, doc))
        return name

    def add_output(self, value: str, name: str, shape: Sequence[int], doc: str) -> None:
        """Declare a value as a named output `(batch, *shape)` of the graph."""
        self.nodes.append(self._onnx.helper.make_node("Identity", [value], [name]))
        self.outputs.append(self._described(name, shape, doc))

    def add_constant(self, values: Any) -> str:
        """Add a constant of floats (as double) or integers, and return its name."""
        array = np.asarray(values)
        array = array.astype(np.int64 if array.dtype.kind in "iu" else np.float64)
        name = f"constant_{len(self._constants)}"
        self._constants.append(self._onnx.numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def add_node(self, operator: str, *operands: Any, **attributes: Any) -> str:
        """Apply an operator to values (by name) and constants (numbers or arrays), and return the result's name."""
        names = [value if isinstance(value, str) else self.add_constant(value) for value in operands]
        result = f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(self._onnx.helper.make_node(operator, names, [result], **attributes))
        return result

    def columns(self, value: str, indices: Sequence[int]) -> str:
        """Select columns of `(batch, n)`, or slices of the second dimension."""
        return self.add_node("Gather", value, np.array(indices, dtype=np.int64), axis=1)

    def column(self, value: str, index: int) -> str:
        """Select one column of `(batch, n)` as `(batch, 1)`."""
        return self.columns(value, [index])

    def reshape(self, value: str, shape: Sequence[int]) -> str:
        """Reshape a value to `(batch, *shape)`; one dimension may be -1."""
        return self.add_node("Reshape", value, np.array([0, *shape], dtype=np.int64))

    def add_sum(self, value: str, axis: int) -> str:
        """Sum over a dimension, which is removed."""
        return self.add_node("ReduceSum", value, np.array([axis], dtype=np.int64), keepdims=0)

    def sum_of_products(self, factors: str, orders: Sequence[int]) -> str:
        """Sum over units of the products of their factors: `(batch, outputs, factors)` to `(batch, outputs)`."""
        total, first = "", 0
        for order in orders:
            own = self.add_node("Gather", factors, np.arange(first, first + order), axis=2)
            value = self.add_node("ReduceProd", own, axes=[2], keepdims=0)
            total = self.add_node("Add", total, value) if total else value
            first += order
        return total

    def angle(self, sine: str, cosine: str) -> str:
        """Add `atan2(sine, cosine)` in full double precision, for values of any length.

        Runtimes have no inverse trigonometric functions in double precision. The function in single precision returns
        an angle a; the exact angle is `a + asin(u)` with `u = (sine cos a - cosine sin a) / length`, about 1e-7, so two
        terms of asin suffice.
        """
        node, doubles, floats = self.add_node, self._onnx.TensorProto.DOUBLE, self._onnx.TensorProto.FLOAT
        high, wide = node("Abs", sine), node("Abs", cosine)
        ratio = node("Div", node("Min", high, wide), node("Max", high, wide, _TINY))
        a = node("Cast", node("Atan", node("Cast", ratio, to=floats)), to=doubles)
        a = node("Where", node("Greater", high, wide), node("Sub", math.pi / 2, a), a)
        a = node("Where", node("Less", cosine, 0.0), node("Sub", math.pi, a), a)
        below = node("Less", node("Reciprocal", sine), 0.0)  # -0 is treated as negative, as in atan2
        a = node("Where", below, node("Neg", a), a)
        square = node("Add", node("Mul", sine, sine), node("Mul", cosine, cosine))
        length = node("Max", node("Sqrt", square), _TINY)
        off = node("Sub", node("Mul", sine, node("Cos", a)), node("Mul", cosine, node("Sin", a)))
        u = node("Div", off, length)
        third = node("Div", node("Mul", u, node("Mul", u, u)), 6.0)
        return node("Add", a, node("Add", u, third))

    def to_bytes(self, name: str, doc: str, metadata: dict[str, str]) -> bytes:
        """Check the ONNX model, and return it as the content of a file."""
        from pisigma import __version__

        helper = self._onnx.helper
        graph = helper.make_graph(
            self.nodes, name, self.inputs, self.outputs, self._constants, doc_string=doc
        )
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", _OPSET)],
            ir_version=_IR_VERSION,
            producer_name="pisigma",
            producer_version=__version__,
            doc_string=doc,
        )
        helper.set_model_props(model, metadata)
        self._onnx.checker.check_model(model, full_check=True)
        content: bytes = model.SerializeToString()
        return content

    def _described(self, name: str, shape: Sequence[int], doc: str) -> Any:
        double = self._onnx.TensorProto.DOUBLE
        return self._onnx.helper.make_tensor_value_info(name, double, [BATCH, *shape], doc_string=doc)
