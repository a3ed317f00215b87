"""A policy as an ONNX graph: one input per entry of the observation, one output, the action."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from scilab_rl import files
from scilab_rl.deployment.description import Entry, Layer, Normalization, Output, PolicyDescription
from scilab_rl.errors import MissingDependencyError

# Old enough for the runtimes on robots.
_OPSET, _IR_VERSION = 17, 8
_OPERATORS = {"relu": "Relu", "tanh": "Tanh", "elu": "Elu", "leaky_relu": "LeakyRelu"}
ACTION = "action"
ONLY_ENTRY = "observation"  # the input where the observation is a single array


def write_onnx(policy: PolicyDescription, path: Path, about: Mapping[str, str]) -> None:
    """Write a policy as an ONNX graph for batches of any size.

    Args:
        policy: The policy.
        path: The file.
        about: Written into the file's metadata.

    Raises:
        MissingDependencyError: If ``onnx`` is not installed.
    """
    try:
        import onnx
    except ImportError as error:
        raise MissingDependencyError("onnx", "onnx", "to write policy.onnx") from error
    graph = _Graph(onnx)
    numbers = graph.concatenated([graph.entry(entry) for entry in policy.entries])
    if policy.normalization is not None:
        numbers = graph.normalized(numbers, policy.normalization)
    for layer in policy.layers:
        numbers = graph.dense(numbers, layer)
    graph.action(numbers, policy.output)
    model = graph.model(about)
    onnx.checker.check_model(model, full_check=True)
    files.atomic_write(path, lambda file: file.write(model.SerializeToString()))


class _Graph:
    """Builds a graph node by node; each method returns the name of its result."""

    def __init__(self, onnx: Any) -> None:
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self.inputs: list[Any] = []
        self.outputs: list[Any] = []

    def node(self, operator: str, *inputs: str, name: str | None = None, **values: Any) -> str:
        """Add an operator."""
        name = name or f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(operator, inputs, [name], **values))
        return name

    def constant(self, values: Any, dtype: Any) -> str:
        """Add numbers that do not change."""
        name = f"constant_{len(self.constants)}"
        array = np.ascontiguousarray(values, dtype)
        self.constants.append(self.onnx.numpy_helper.from_array(array, name))
        return name

    def entry(self, entry: Entry) -> str:
        """Add an input, and what turns it into numbers of the network."""
        name = entry.name or ONLY_ENTRY
        shape = list(entry.space.shape or ())
        kind = np.dtype(entry.space.dtype)
        if kind not in (np.float32, np.float64):
            kind = np.dtype(np.int64)
        self.inputs.append(
            self.onnx.helper.make_tensor_value_info(name, self._type(kind), ["batch", *shape])
        )
        n_numbers = int(np.prod(shape))
        numbers = self.node("Reshape", name, self.constant([-1, n_numbers], np.int64))
        if entry.columns is not None:
            numbers = self.node("Gather", numbers, self.constant(entry.columns, np.int64), axis=1)
            numbers = self.node("Equal", numbers, self.constant(entry.values, np.int64))
        elif entry.normalization is not None:
            return self.normalized(numbers, entry.normalization)
        return self._cast(numbers, np.float32)

    def concatenated(self, parts: list[str]) -> str:
        """Join the entries."""
        return self.node("Concat", *parts, axis=1)

    def normalized(self, numbers: str, by: Normalization) -> str:
        """Normalize in double precision, as the policy itself does."""
        wide = self._cast(numbers, np.float64)
        centered = self.node("Sub", wide, self.constant(by.mean, np.float64))
        scaled = self.node("Div", centered, self.constant(by.scale, np.float64))
        return self._cast(self._clipped(scaled, -by.limit, by.limit, np.float64), np.float32)

    def dense(self, numbers: str, layer: Layer) -> str:
        """Add a layer."""
        weight = self.constant(layer.weight, np.float32)
        result = self.node("Gemm", numbers, weight, self.constant(layer.bias, np.float32))
        if layer.activation == "silu":
            return self.node("Mul", result, self.node("Sigmoid", result))
        if layer.activation == "none":
            return result
        return self.node(_OPERATORS[layer.activation], result)

    def action(self, numbers: str, output: Output) -> None:
        """Turn the last numbers into the action, the only output."""
        space = output.space
        if isinstance(space, spaces.Discrete):
            best = self.node("ArgMax", numbers, axis=1, keepdims=0)
            self.node("Add", best, self.constant(space.start, np.int64), name=ACTION)
            self._has_output(np.int64, ["batch"])
            return
        assert isinstance(space, spaces.Box)
        scaled = self.node("Mul", numbers, self.constant(output.scale, np.float32))
        shifted = self.node("Add", scaled, self.constant(output.offset, np.float32))
        bounded = self._clipped(shifted, space.low.ravel(), space.high.ravel(), np.float32)
        shape = self.constant([-1, *space.shape], np.int64)
        self.node("Reshape", bounded, shape, name=ACTION)
        self._has_output(np.float32, ["batch", *space.shape])

    def model(self, about: Mapping[str, str]) -> Any:
        """Return the whole."""
        helper = self.onnx.helper
        graph = helper.make_graph(self.nodes, "policy", self.inputs, self.outputs, self.constants)
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION
        )
        helper.set_model_props(model, dict(about))
        return model

    def _has_output(self, dtype: Any, shape: list[Any]) -> None:
        value = self.onnx.helper.make_tensor_value_info(ACTION, self._type(np.dtype(dtype)), shape)
        self.outputs.append(value)

    def _clipped(self, numbers: str, low: Any, high: Any, dtype: Any) -> str:
        raised = self.node("Max", numbers, self.constant(low, dtype))
        return self.node("Min", raised, self.constant(high, dtype))

    def _cast(self, numbers: str, dtype: Any) -> str:
        return self.node("Cast", numbers, to=self._type(np.dtype(dtype)))

    def _type(self, dtype: np.dtype) -> int:
        return int(self.onnx.helper.np_dtype_to_tensor_dtype(dtype))
