"""Recorded computations: NumPy functions called on symbols, kept as operations for other languages.

Sensors, estimator, networks, maps, law and faults are written once, with the functions of their arrays'
library (`mjx_softarm._support.xp`). A `Symbol` is an array of known shape and type whose library is this
module. A function called on symbols returns symbols, and each symbol knows its operation and its operands.
NumPy itself decides shapes and types: every operation is tried on arrays of ones.

The operations are NumPy's functions of the same name. All are elementwise except

    input                            `option`: its name
    constant                         `option`: its array
    cast, reshape                    type and shape are the symbol's
    index                            `option`: places (shape) of the elements in the flat operand
    concat, sum, min, max, all       `option`: the axis, or a tuple of axes
    matmul                           as NumPy's
    repeat                           `option`: a `Repeat`; the operand is the start
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

REDUCTIONS = ("sum", "min", "max", "all")


@dataclass(frozen=True, eq=False)
class Symbol:
    """One array of a recorded computation."""

    op: str
    operands: tuple[Symbol, ...]
    shape: tuple[int, ...]
    dtype: np.dtype
    option: Any = None

    __array_ufunc__ = None  # NumPy arrays leave operators to this class

    def __array_namespace__(self) -> Any:
        return _NAMESPACE

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> Symbol:
        return _placed(self, np.arange(self.size).reshape(self.shape)[key])

    def reshape(self, *shape: int) -> Symbol:
        return Symbol("reshape", (self,), np.empty(self.shape).reshape(*shape).shape, self.dtype)

    def __neg__(self) -> Symbol:
        return elementwise("negative", self)

    def __invert__(self) -> Symbol:
        return elementwise("logical_not", self)

    def __pow__(self, power: int) -> Symbol:
        if power != 2:
            raise NotImplementedError(f"power: got {power}, expected 2")
        return elementwise("multiply", self, self)

    def __eq__(self, other: Any) -> Any:
        return elementwise("equal", self, other)

    def __ne__(self, other: Any) -> Any:
        return elementwise("logical_not", elementwise("equal", self, other))

    def __bool__(self) -> bool:
        raise TypeError(f"{self.op}: got a symbol as a condition, expected `where`")

    __hash__ = object.__hash__


class Repeat(NamedTuple):
    """A computation from a symbol to another of the same shape and type, repeated n times."""

    before: Symbol
    after: Symbol
    n: int


def _operator(name: str, swapped: bool = False) -> Callable[[Symbol, Any], Symbol]:
    def operate(self: Symbol, other: Any) -> Symbol:
        return getattr(_NAMESPACE, name)(*((other, self) if swapped else (self, other)))

    return operate


_OPERATORS = {"add": "add", "sub": "subtract", "mul": "multiply", "truediv": "divide", "matmul": "matmul"}
_OPERATORS |= {"and": "logical_and", "or": "logical_or"}
for _word, _name in _OPERATORS.items():
    setattr(Symbol, f"__{_word}__", _operator(_name))
    setattr(Symbol, f"__r{_word}__", _operator(_name, swapped=True))
for _word, _name in {"lt": "less", "le": "less_equal", "gt": "greater", "ge": "greater_equal"}.items():
    setattr(Symbol, f"__{_word}__", _operator(_name))


def symbol(name: str, shape: tuple[int, ...], dtype: Any = np.float64) -> Symbol:
    """Return an input of a computation."""
    return Symbol("input", (), shape, np.dtype(dtype), name)


def constant(value: Any) -> Symbol:
    """Return a number or an array as a symbol; a symbol as it is."""
    if isinstance(value, Symbol):
        return value
    array = np.asarray(value)
    return Symbol("constant", (), array.shape, array.dtype, array)


def elementwise(name: str, *operands: Any) -> Symbol:
    """Record an elementwise operation; plain numbers take the arrays' type, as in NumPy."""
    like = _tried(name, *operands)
    values = operands[1:] if name == "where" else operands
    common = np.result_type(*(_one(value) for value in values))
    taken = [value if hasattr(value, "dtype") else np.asarray(value, common) for value in operands]
    return Symbol(name, tuple(map(constant, taken)), like.shape, like.dtype)


def _placed(x: Symbol, places: Any) -> Symbol:
    """Return the elements of a symbol at places in flat order."""
    return Symbol("index", (x,), np.shape(places), x.dtype, np.asarray(places))


def repeat(step: Callable[[Symbol], Symbol], start: Symbol, n: int) -> Symbol:
    """Record n applications of a function."""
    before = symbol("before", start.shape, start.dtype)
    return Symbol("repeat", (start,), start.shape, start.dtype, Repeat(before, step(before), n))


def ordered(results: Iterable[Symbol]) -> list[Symbol]:
    """Return the results and all symbols that they depend on, each after its operands."""
    order: dict[Symbol, None] = {}

    def visit(item: Symbol) -> None:
        if item not in order:
            for operand in item.operands:
                visit(operand)
            order[item] = None

    for result in results:
        visit(result)
    return list(order)


def _one(value: Any) -> Any:
    """Return an array of ones like a symbol."""
    return np.ones(value.shape, value.dtype) if isinstance(value, Symbol) else value


def _tried(name: str, *operands: Any, **options: Any) -> Any:
    with np.errstate(all="ignore"):
        return getattr(np, name)(*map(_one, operands), **options)


def _reduced(name: str, x: Symbol, axis: Any = None) -> Symbol:
    like = _tried(name, x, axis=axis)
    axes = tuple(range(x.ndim)) if axis is None else (axis,) if isinstance(axis, int) else axis
    return Symbol(name, (x,), like.shape, like.dtype, tuple(sorted(item % x.ndim for item in axes)))


def _mean(x: Symbol, axis: Any = None) -> Symbol:
    total = _reduced("sum", x, axis)
    return elementwise("divide", total, x.size / total.size)


def _concat(arrays: Iterable[Any], axis: int = 0) -> Symbol:
    arrays = list(arrays)
    like = np.concat([_one(array) for array in arrays], axis=axis)
    parts = tuple(_cast(constant(array), like.dtype) for array in arrays)
    return Symbol("concat", parts, like.shape, like.dtype, axis % like.ndim)


def _stack(arrays: Iterable[Any], axis: int = -1) -> Symbol:
    if axis != -1:
        raise NotImplementedError(f"stack: got axis {axis}, expected -1")
    return _concat([constant(array)[..., None] for array in arrays], axis=-1)


def _cast(x: Symbol, dtype: Any) -> Symbol:
    return x if x.dtype == dtype else Symbol("cast", (x,), x.shape, np.dtype(dtype))


def _matmul(a: Any, b: Any) -> Symbol:
    like = _tried("matmul", a, b)
    operands = tuple(_cast(constant(value), like.dtype) for value in (a, b))
    return Symbol("matmul", operands, like.shape, like.dtype)


_OTHER_NAMES = {"abs": "absolute", "atan2": "arctan2", "acos": "arccos"}
_OWN = {
    "matmul": _matmul,
    "mean": _mean,
    "concat": _concat,
    "stack": _stack,
    "swapaxes": lambda x, a, b: _placed(x, np.arange(x.size).reshape(x.shape).swapaxes(a, b)),
    "asarray": lambda x, dtype: _cast(x, dtype),
    "clip": lambda x, low, high: _NAMESPACE.minimum(_NAMESPACE.maximum(x, low), high),
    "rad2deg": lambda x: elementwise("multiply", x, 180.0 / math.pi),
    "deg2rad": lambda x: elementwise("multiply", x, math.pi / 180.0),
    "ones_like": lambda x: constant(np.ones(x.shape, x.dtype)),
    "zeros_like": lambda x: constant(np.zeros(x.shape, x.dtype)),
}


class _Namespace:
    """NumPy's functions on symbols; without symbols they are NumPy's own."""

    def __getattr__(self, name: str) -> Any:
        plain = getattr(np, name)
        known = _OTHER_NAMES.get(name, name)
        if not callable(plain) or isinstance(plain, type):  # a number or a type
            return plain

        def function(*operands: Any, **options: Any) -> Any:
            if not any(isinstance(value, Symbol) for value in _flat(operands)):
                return plain(*operands, **options)
            if known in _OWN:
                return _OWN[known](*operands, **options)
            if known in REDUCTIONS:
                return _reduced(known, *operands, **options)
            return elementwise(known, *operands, **options)

        return function


def _flat(operands: Iterable[Any]) -> Iterator[Any]:
    """Yield operands, and the elements of lists of operands."""
    for operand in operands:
        yield from operand if isinstance(operand, list | tuple) else (operand,)


_NAMESPACE = _Namespace()
