"""A policy as ONNX graphs: numbers in float32, operators of opset 17 that every build of onnxruntime has.

The metadata entry `mjx_softarm` describes the graph's inputs and outputs, as JSON with numbers in full
precision. The entry `sha256` is the checksum of everything else.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from mjx_softarm._support.errors import InputError
from mjx_softarm.export.computations import Computation
from mjx_softarm.export.symbols import Symbol, ordered

OPSET, IR_VERSION = 17, 8
ABOUT, SEAL = "mjx_softarm", "sha256"  # entries of the metadata
SCHEMA_VERSION = 1

_SAME = ("add", "sqrt", "exp", "sin", "cos", "tanh", "floor", "less", "greater", "equal", "where")
_OPERATORS = {name: name.title() for name in _SAME}
_OPERATORS |= {"subtract": "Sub", "multiply": "Mul", "divide": "Div", "negative": "Neg", "matmul": "MatMul"}
_OPERATORS |= {"arccos": "Acos", "absolute": "Abs", "maximum": "Max", "minimum": "Min"}
_OPERATORS |= {"less_equal": "LessOrEqual", "greater_equal": "GreaterOrEqual"}
_OPERATORS |= {"logical_and": "And", "logical_or": "Or", "logical_not": "Not"}
_TYPES = {"f": TensorProto.FLOAT, "i": TensorProto.INT32, "b": TensorProto.BOOL}  # by NumPy's kind


def write_onnx(path: Path, computation: Computation, about: Mapping[str, Any], defaults: Mapping) -> None:
    """Write a computation as one graph, whose inputs are float32.

    `about` is the description for the metadata, in types that JSON has; `defaults` are the values of optional
    inputs, by name.
    """
    # Nodes and tensors.
    writer = _Writer()
    for name, result in computation.outputs.items():
        writer.node("Identity", [writer.name(result)], output=name)
    for name, value in defaults.items():
        writer.tensors[name] = numpy_helper.from_array(np.asarray(value, np.float32), name)
    # Graph with typed inputs and outputs.
    graph = helper.make_graph(
        writer.nodes,
        "policy",
        [helper.make_tensor_value_info(item.option, _TYPES["f"], item.shape) for item in computation.inputs],
        [
            helper.make_tensor_value_info(name, _TYPES[item.dtype.kind], item.shape)
            for name, item in computation.outputs.items()
        ],
        list(writer.tensors.values()),
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name=ABOUT
    )
    onnx.checker.check_model(model, full_check=True)
    # Metadata, with the checksum last.
    about = {"schema_version": SCHEMA_VERSION, **about}
    helper.set_model_props(model, {ABOUT: json.dumps(about)})
    helper.set_model_props(model, {ABOUT: json.dumps(about), SEAL: _digest(model)})
    path.write_bytes(model.SerializeToString(deterministic=True))


def read_onnx(path: Path) -> tuple[bytes, dict[str, Any]]:
    """Return a graph's bytes, for onnxruntime, and its description.

    Raises:
        InputError: the file cannot be read, is incomplete, damaged, or of another program or version.
    """
    expected = "an unchanged file of `python -m train export RUN --onnx`"
    try:
        data = path.read_bytes()
        model = onnx.load_from_string(data)
    except OSError as error:
        raise InputError(f"{path}: got {error.strerror!r}, expected {expected}") from error
    except Exception as error:  # the class of protobuf's DecodeError depends on the installed package
        raise InputError(f"{path}: got no ONNX graph, {len(data)} bytes, expected {expected}") from error
    entries = {item.key: item.value for item in model.metadata_props}
    if not entries.keys() >= {ABOUT, SEAL}:
        raise InputError(f"{path}: got an ONNX graph of another program, expected {expected}")
    if entries[SEAL] != _digest(model):
        raise InputError(f"{path}: got a graph without its checksum, expected {expected}")
    about = json.loads(entries[ABOUT])
    if about["schema_version"] != SCHEMA_VERSION:
        got = f"schema_version: got {about['schema_version']}, expected {SCHEMA_VERSION}"
        raise InputError(f"{path}: {got}; `python -m train export RUN --onnx` writes it anew")
    return data, about


def _digest(model: onnx.ModelProto) -> str:
    """Return the SHA-256 of a model without its checksum."""
    bare = onnx.ModelProto()
    bare.CopyFrom(model)
    kept = [item for item in bare.metadata_props if item.key != SEAL]
    del bare.metadata_props[:]
    bare.metadata_props.extend(kept)
    return hashlib.sha256(bare.SerializeToString(deterministic=True)).hexdigest()


class _Writer:
    """Nodes and tensors of a graph."""

    def __init__(self, prefix: str = "v", tensors: dict[str, onnx.TensorProto] | None = None) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.tensors = {} if tensors is None else tensors  # a loop's body shares its graph's tensors
        self._names: dict[Symbol, str] = {}
        self._prefix = prefix

    def name(self, item: Symbol) -> str:
        """Return the name of a symbol's value; write the nodes that it needs."""
        for needed in ordered([item]):
            if needed not in self._names:
                self._names[needed] = self._write(needed)
        return self._names[item]

    def node(self, operator: str, inputs: list[str], output: str | None = None, **attributes: Any) -> str:
        """Add a node; return the name of its output."""
        output = output or f"{self._prefix}{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, inputs, [output], **attributes))
        return output

    def tensor(self, value: Any) -> str:
        """Add a tensor, once for all equal ones; return its name."""
        array = np.asarray(value)
        narrow = {"f": np.float32, "i": np.int64 if array.dtype == np.int64 else np.int32, "b": np.bool_}
        array = array.astype(narrow[array.dtype.kind])
        key = f"{array.shape}{array.dtype}".encode() + array.tobytes()
        name = f"c{hashlib.sha256(key).hexdigest()[:12]}"
        self.tensors[name] = numpy_helper.from_array(array, name)
        return name

    def _write(self, item: Symbol) -> str:
        names = [self._names[operand] for operand in item.operands]
        if item.op == "input":
            return item.option
        if item.op == "constant":
            return self.tensor(item.option)
        if item.op in _OPERATORS:
            return self.node(_OPERATORS[item.op], names)
        return getattr(self, f"_{item.op}")(item, *names)

    def _cast(self, item: Symbol, x: str) -> str:
        kinds = item.operands[0].dtype.kind, item.dtype.kind
        return x if kinds[0] == kinds[1] else self.node("Cast", [x], to=_TYPES[kinds[1]])

    def _reshape(self, item: Symbol, x: str) -> str:
        return self.node("Reshape", [x, self.tensor(np.array(item.shape, np.int64))])

    def _index(self, item: Symbol, x: str) -> str:
        flat = self.node("Reshape", [x, self.tensor(np.array([-1], np.int64))])
        return self.node("Gather", [flat, self.tensor(item.option.astype(np.int64))], axis=0)

    def _concat(self, item: Symbol, *parts: str) -> str:
        return self.node("Concat", list(parts), axis=item.option)

    def _sum(self, item: Symbol, x: str) -> str:
        return self.node("ReduceSum", [x, self.tensor(np.array(item.option, np.int64))], keepdims=0)

    def _min(self, item: Symbol, x: str) -> str:
        return self.node("ReduceMin", [x], axes=list(item.option), keepdims=0)

    def _max(self, item: Symbol, x: str) -> str:
        return self.node("ReduceMax", [x], axes=list(item.option), keepdims=0)

    def _all(self, item: Symbol, x: str) -> str:
        number = self.node("Cast", [x], to=TensorProto.INT32)
        return self.node("Cast", [self._min(item, number)], to=TensorProto.BOOL)

    def _repeat(self, item: Symbol, start: str) -> str:
        before, after, n = item.option
        inside = _Writer(f"{before.option}_", self.tensors)
        results = [inside.node("Identity", ["on"]), inside.name(after)]
        like = {"elem_type": _TYPES[item.dtype.kind], "shape": item.shape}
        flag = {"elem_type": TensorProto.BOOL, "shape": ()}
        info = helper.make_tensor_value_info
        takes = [info("step", TensorProto.INT64, ()), info("on", **flag), info(before.option, **like)]
        gives = [info(results[0], **flag), info(results[1], **like)]
        body = helper.make_graph(inside.nodes, "repeated", takes, gives)
        return self.node("Loop", [self.tensor(np.int64(n)), self.tensor(np.bool_(True)), start], body=body)

    def _isfinite(self, item: Symbol, x: str) -> str:
        """Compare x - x with itself: it is NaN, which equals nothing, if x is not finite."""
        zero = self.node("Sub", [x, x])
        return self.node("Equal", [zero, zero])

    def _arctan2(self, item: Symbol, y: str, x: str) -> str:
        """Take ONNX's arctangent of y / x, and add half a turn where x < 0."""
        zero, none = self.tensor(np.float32(0.0)), self.node("Equal", [x, self.tensor(np.float32(0.0))])
        slope = self.node("Div", [y, self.node("Where", [none, self.tensor(np.float32(1.0)), x])])
        half_turn = [self.tensor(np.float32(sign * np.pi)) for sign in (-1.0, 1.0)]
        turn = self.node("Where", [self.node("Less", [y, zero]), *half_turn])
        turn = self.node("Where", [self.node("Less", [x, zero]), turn, zero])
        angle = self.node("Add", [self.node("Atan", [slope]), turn])
        upright = self.node("Mul", [self.node("Sign", [y]), self.tensor(np.float32(0.5 * np.pi))])
        return self.node("Where", [none, upright, angle])
