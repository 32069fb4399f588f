"""A policy and its control loop as C++ sources: a header with all numbers, two programs, a CMake file.

Recorded computations become C++ functions: loops over arrays of fixed size, without allocation. An operation
whose elements are read once is written into the expression that reads them; every other operation gets an
array of its own. `_places` finds a formula for the place of an element in an operand that is broadcast or
indexed. If there is no formula, a table holds the places.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from importlib import resources
from typing import Any

import numpy as np

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.link import LATE_TICKS, LOST_TICKS
from mjx_softarm.deploy.safety import MOVING_WINDOWS, OVERLOAD, REST_WINDOWS, Fault, Response
from mjx_softarm.deploy.strategy import CORRECTION_SHARE, N_CORRECTIONS, SHARES
from mjx_softarm.export.computations import Computation, parts
from mjx_softarm.export.golden import FLAGS, PROGRAM_VERSION
from mjx_softarm.export.symbols import REDUCTIONS, Symbol, ordered
from mjx_softarm.mdp.actions import SHIFT_LIMIT
from mjx_softarm.mdp.observation import rate_ticks
from mjx_softarm.policy.file import file_entries
from mjx_softarm.policy.lag import SETTLE_TIMEOUT_S
from mjx_softarm.policy.reach import N_STEPS, begin
from mjx_softarm.sensing.load import HIGHEST, JUMP, KNOWN, LOWEST, N_AVERAGED, N_JUMPS, QUANTILE

_TEMPLATES = ("softarm.hpp.in", "rows.cpp", "example.cpp", "CMakeLists.txt")
_TYPES = {"float64": "double", "float32": "float", "int32": "int", "int64": "int", "bool": "bool"}
_VIEWS = ("reshape", "index")
_BINARY = {"add": "+", "subtract": "-", "multiply": "*", "divide": "/", "less": "<", "less_equal": "<="}
_BINARY |= {"greater": ">", "greater_equal": ">=", "equal": "==", "logical_and": "&&", "logical_or": "||"}
_FUNCTIONS = {"arccos": "acos", "absolute": "fabs", "isfinite": "isfinite"}
_FUNCTIONS |= {name: name for name in ("sqrt", "exp", "sin", "cos", "tanh", "floor")}
_EXPRESSIONS = {
    "negative": "(-{})",
    "logical_not": "(!{})",
    "where": "({} ? {} : {})",
    "maximum": "most({}, {})",
    "minimum": "least({}, {})",
    **{name: f"({{}} {sign} {{}})" for name, sign in _BINARY.items()},
    **{name: f"std::{name_cpp}({{}})" for name, name_cpp in _FUNCTIONS.items()},
    "arctan2": "std::atan2({}, {})",
}
# Initial value of a reduction, and its statement for each element.
_FOLDS = {
    "sum": ("0", "{} += {};"),
    "min": ("INFINITY", "{0} = least({0}, {1});"),
    "max": ("-INFINITY", "{0} = most({0}, {1});"),
    "all": ("true", "{0} = {0} && {1};"),
}


def sources(controller: Controller, policy_sha256: str) -> dict[str, str]:
    """Return the text of each file by its name."""
    # Functions and numbers of the policy.
    policy = controller.policy
    numbers = Numbers(file_entries(policy))
    functions = [function(name, part, numbers) for name, part in parts(controller).items()]
    faults = [f"  {fault.name} = 1u << {k},  // {fault.response.value}" for k, fault in enumerate(Fault)]
    vents = [fault.name for fault in Fault if fault.response is Response.VENT]
    most_kg = float(policy.load_estimator.load_scale_kg)
    # Values of the templates' marks.
    values = {
        "SHA256": policy_sha256,
        "PROGRAM_VERSION": PROGRAM_VERSION,
        "N_FLAGS": len(FLAGS),
        "N_SPRINGS": policy.spec.n_springs,
        "N_CHAMBERS": policy.spec.n_chambers,
        "RATE": f"{policy.rate_hz:g}",
        "PERIOD": repr(controller.dt_s),
        "UNIT": policy.sensor.unit,
        "FAULTS": "\n".join(faults),
        "N_FAULTS": len(Fault),
        "VENTS": " | ".join([*vents, "NOT_FINITE"]),
        "NUMBERS": numbers.text(),
        "PARTS": "\n".join(functions),
        "WINDOW": controller.window,
        "N_ACTIONS": policy.n_actions,
        "ACTION": repr(float(policy.action_s)),
        "RATE_TICKS": rate_ticks(policy.rate_hz),
        "LOST_TICKS": LOST_TICKS,
        "LATE_TICKS": LATE_TICKS,
        "REST_TICKS": REST_WINDOWS * controller.window,
        "MOVING_TICKS": MOVING_WINDOWS * controller.window,
        "TIMEOUT": repr(SETTLE_TIMEOUT_S),
        "SEARCH": begin(policy, 1).size,
        "SEARCH_STEPS": N_STEPS,
        "THRESHOLD": repr(policy.reward.threshold),
        "OBSERVES_LOAD": str(controller.observes_payload).lower(),
        "OWN_LOAD": repr(policy.spec.mass.payload_kg),
        "QUANTILE": repr(QUANTILE),
        "LEAST_LOAD": repr(LOWEST * most_kg),
        "GREATEST_LOAD": repr(HIGHEST * most_kg),
        "LOAD_KNOWN": repr(KNOWN * most_kg),
        "OVERLOAD": repr(OVERLOAD * most_kg),
        "JUMP": repr(JUMP * most_kg),
        "N_JUMPS": N_JUMPS,
        "N_AVERAGED": N_AVERAGED,
        "LEAST_SHARE": repr(min(SHARES)),
        "MAX_SHIFT": ", ".join(map(repr, SHIFT_LIMIT.tolist())),
        "N_CORRECTIONS": N_CORRECTIONS,
        "CORRECTION_SHARE": repr(CORRECTION_SHARE),
        "GOAL": ", ".join(f"{value:.1f}" for value in policy.workspace[0]),
    }
    # Fill the templates.
    texts = {}
    for template in _TEMPLATES:
        text = resources.files("mjx_softarm").joinpath(f"export/templates/{template}").read_text("utf-8")
        for key, value in values.items():
            text = text.replace(f"@{key}@", str(value))
        texts[template.removesuffix(".in")] = text
    return texts


class Numbers:
    """Constant arrays of all functions, each once; arrays that have no name are numbered."""

    def __init__(self, names: Mapping[str, np.ndarray]):
        self._known = {_key(array): name.replace(".", "_") for name, array in names.items()}
        self._used: dict[str, np.ndarray] = {}

    def name(self, array: np.ndarray) -> str:
        """Return the name of an array."""
        key = _key(array)
        name = self._known.setdefault(key, f"numbers_{len(self._known)}")
        self._used[name] = array
        return name

    def text(self) -> str:
        """Return the definitions of all arrays that `name` was asked for."""
        return "\n".join(_definition(name, array) for name, array in self._used.items())


def function(name: str, computation: Computation, numbers: Numbers) -> str:
    """Return a computation as a function of inputs, then outputs; unused inputs have no name."""
    read = set(ordered(computation.outputs.values()))
    takes = [
        f"const {_TYPES[item.dtype.name]}*" + (f" {item.option}" if item in read else "")
        for item in computation.inputs
    ]
    gives = [f"{_TYPES[item.dtype.name]}* {key}" for key, item in computation.outputs.items()]
    body = "\n".join(f"  {line}" for line in _Body(computation, numbers).lines)
    return f"inline void {name}({', '.join(takes + gives)}) noexcept {{\n{body}\n}}\n"


class _Body:
    """Statements of one function."""

    def __init__(self, computation: Computation, numbers: Numbers):
        self.lines: list[str] = []
        self._numbers, self._names = numbers, {}
        items = ordered(computation.outputs.values())
        outputs = {item: name for name, item in computation.outputs.items()}
        self._readers = defaultdict(list)
        for item in items:
            for operand in item.operands:
                self._readers[operand].append(item)
        for item in items:
            if item in outputs:
                self._store(item, outputs[item])
            elif item.op not in ("input", "constant", *_VIEWS) and not self._read_once(item):
                name = f"v{len(self._names)}"
                self.lines.append(f"{_TYPES[item.dtype.name]} {name}[{item.size}];")
                self._store(item, name)

    def _read_once(self, item: Symbol) -> bool:
        """Return whether an operation can be written into the expression that reads its result."""
        if item.op not in (*_EXPRESSIONS, "cast", *_VIEWS):
            return False
        if len(self._readers[item]) != 1:
            return False
        [reader] = self._readers[item]
        if reader.op == "matmul" or reader.size > item.size:
            return False
        return reader.op not in _VIEWS or self._read_once(reader)

    def _store(self, item: Symbol, name: str) -> None:
        """Write the loops that fill the array `name`."""
        if item.op == "matmul":
            self._matmul(item, name)
        elif item.op in REDUCTIONS:
            self._reduce(item, name)
        elif item.op == "concat":
            self._concat(item, name)
        else:
            self._loop(item.size, lambda i: f"{name}[{i}] = {self._formula(item, i)};")
        self._names[item] = name

    def _loop(self, size: int, statement: Callable[[str], str]) -> None:
        self.lines.append(_for(("i", size)) + statement("i" if size > 1 else "0"))

    def _value(self, item: Symbol, i: str) -> str:
        """Return the expression of element `i`, counted in flat order."""
        return f"{self._names[item]}[{i}]" if item in self._names else self._formula(item, i)

    def _formula(self, item: Symbol, i: str) -> str:
        if item.op == "input":
            return f"{item.option}[{i}]"
        if item.op == "constant":
            return self._constant(np.asarray(item.option), i)
        if item.op == "reshape":
            return self._value(item.operands[0], i)
        if item.op == "index":
            return self._value(item.operands[0], self._places(item.option, i))
        if item.op == "cast":
            return f"{_TYPES[item.dtype.name]}({self._value(item.operands[0], i)})"
        values = item.operands[1:] if item.op == "where" else item.operands
        common = np.result_type(*(value.dtype for value in values))
        texts = []
        for k, operand in enumerate(item.operands):
            numbered = np.arange(operand.size).reshape(operand.shape)
            text = self._value(operand, self._places(np.broadcast_to(numbered, item.shape), i))
            is_common = operand.dtype == common or (item.op == "where" and k == 0)
            texts.append(text if is_common else f"{_TYPES[common.name]}({text})")
        return _EXPRESSIONS[item.op].format(*texts)

    def _constant(self, value: np.ndarray, i: str) -> str:
        first = value.reshape(-1)[0]
        same = np.array_equal(value, np.full(value.shape, first), equal_nan=value.dtype.kind == "f")
        return _literal(first) if same else f"{self._numbers.name(value)}[{i}]"

    def _places(self, places: np.ndarray, i: str) -> str:
        """Return the expression of the place of element `i`, given the places of all elements."""
        flat = places.reshape(-1)
        count, start = np.arange(flat.size), int(flat[0])
        stride = int(flat[1]) - start if flat.size > 1 else 0
        if np.array_equal(flat, start + stride * count):
            term = {0: "", 1: i}.get(stride, f"{stride} * {_one(i)}")
            return " + ".join(filter(None, [str(start) if start or not term else "", term]))
        period = int(np.argmax(flat[1:] == start)) + 1
        if np.array_equal(flat, count % period):
            return f"{_one(i)} % {period}"
        repeats = int(np.argmax(flat != start))
        if np.array_equal(flat, count // repeats):
            return f"{_one(i)} / {repeats}"
        # Rows that are alike: the place where a row begins, and the place within it
        n = places.shape[-1]
        rows = flat.reshape(-1, n)
        within = rows[0] - start
        if min(len(rows), n) > 1 and np.array_equal(rows, rows[:, :1] + within):
            row = self._places(places[..., 0], f"({_one(i)} / {n})")
            return f"{_one(row)} + {_one(self._places(within, f'({_one(i)} % {n})'))}"
        return f"{self._numbers.name(flat.astype(np.int32))}[{i}]"

    def _matmul(self, item: Symbol, name: str) -> None:
        a, b = item.operands
        n_rows, n_inner = (1, *a.shape)[-2:] if b.ndim > 2 else (a.size // a.shape[-1], a.shape[-1])
        n_columns = 1 if b.ndim == 1 else b.shape[-1]
        n_batch = math.prod(b.shape[:-2])
        n_own = n_batch if b.ndim > 2 and a.ndim > 2 else 1  # a single left matrix serves the whole batch
        if b.ndim > 2 and n_own != math.prod(a.shape[:-2]):
            raise NotImplementedError(f"matmul: got {a.shape} and {b.shape}, expected equal leading axes")
        batch, row, inner, column = ("b", n_batch), ("r", n_rows), ("k", n_inner), ("c", n_columns)
        x = self._value(a, _flat(("b", n_own), row, inner))
        weight = self._value(b, _flat(batch, inner, column))
        target = f"{name}[{_flat(batch, row, column)}]"
        outside, columns = "".join(map(_for, (batch, row))), _for(column)
        self.lines += [
            f"{outside}{{" if outside else "{",
            f"  {columns}{target} = 0;",
            f"  for (int k = 0; k < {n_inner}; ++k) {{",
            f"    const {_TYPES[item.dtype.name]} x = {x};",
            f"    {columns}{target} += x * {weight};",
            "  }",
            "}",
        ]

    def _reduce(self, item: Symbol, name: str) -> None:
        [x], axes = item.operands, item.option
        n_reduced = math.prod(x.shape[axis] for axis in axes)
        n_inner = math.prod(x.shape[axes[-1] + 1 :])
        first, fold = _FOLDS[item.op]
        places = {1: f"i * {n_reduced} + k", item.size: f"k * {n_inner} + i"}
        between = f"((i / {n_inner}) * {n_reduced} + k) * {n_inner} + i % {n_inner}"
        value = self._value(x, "k" if item.size == 1 else places.get(n_inner, between))
        self.lines += [
            f"for (int i = 0; i < {item.size}; ++i) {{",
            f"  {_TYPES[item.dtype.name]} folded = {first};",
            f"  for (int k = 0; k < {n_reduced}; ++k) {fold.format('folded', value)}",
            f"  {name}[i] = folded;",
            "}",
        ]

    def _concat(self, item: Symbol, name: str) -> None:
        n_inner, start = math.prod(item.shape[item.option + 1 :]), 0
        n_row = item.shape[item.option] * n_inner
        for part in item.operands:
            n = part.shape[item.option] * n_inner
            place = f"{start} + i" if n == part.size else f"i / {n} * {n_row} + {start} + i % {n}"
            place = f"i * {n_row} + {start}" if n == 1 else place
            self.lines.append(
                f"for (int i = 0; i < {part.size}; ++i) {name}[{place}] = {self._value(part, 'i')};"
            )
            start += n


def _one(text: str) -> str:
    """Return an expression that can be an operand: in brackets unless it is a word."""
    return text if text.isalnum() else f"({text})"


def _flat(*indices: tuple[str, int]) -> str:
    """Return the expression of a place in flat order from indices, each with the size of its axis."""
    text = ""
    for name, size in indices:
        if size > 1:
            text = f"{_one(text)} * {size} + {name}" if text else name
    return text or "0"


def _for(index: tuple[str, int]) -> str:
    name, size = index
    return f"for (int {name} = 0; {name} < {size}; ++{name}) " if size > 1 else ""


def _key(array: np.ndarray) -> tuple:
    return array.dtype.str, array.size, np.ascontiguousarray(array).tobytes()


def _literal(value: Any) -> str:
    """Return a NumPy number as C++ writes it, with all digits."""
    if value.dtype.kind == "b":
        return "true" if value else "false"
    if value.dtype.kind == "i":
        return str(int(value))
    if np.isnan(value):
        return f"{_TYPES[value.dtype.name]}(NAN)"
    text = np.format_float_scientific(value, trim="0") if value else "0.0"
    return f"{text}f" if value.dtype == np.float32 else text


def _definition(name: str, array: np.ndarray) -> str:
    texts = [_literal(value) for value in array.reshape(-1)]
    rows = [", ".join(texts[k : k + 8]) for k in range(0, len(texts), 8)]
    body = ",\n  ".join(rows)
    return f"inline constexpr {_TYPES[array.dtype.name]} {name}[{len(texts)}] = {{\n  {body}}};"
