"""What a compiled program makes a GPU do, loop by loop: kernels and bytes, read from the text of its HLO.

A kernel is an instruction outside of fusions that computes or copies; a fusion is one. A library's call
counts as one, although it may launch several. Bytes are those of operands and results as if each were read or
written whole: no more than these move, since an operand may be read in part, or still be in a cache.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

NO_KERNEL = {
    *("parameter", "constant", "tuple", "get-tuple-element", "bitcast"),
    *("after-all", "add-dependency", "opt-barrier", "domain", "partition-id", "replica-id"),
}
EXCHANGES = ("all-gather", "all-reduce", "all-to-all", "collective-permute", "reduce-scatter")

_COMPUTATION = re.compile(r"(ENTRY )?%(\S+) \(.*\{$")
_INSTRUCTION = re.compile(r"\s+(?:ROOT )?%(\S+) = (\(.*?\)|\S+) ([\w-]+)\((.*)")
_ARRAY = re.compile(r"(pred|[a-z]+(\d+)\w*)\[([\d,]*)\]")
_TURNS = re.compile(r'"known_trip_count":\{"n":"(\d+)"')
_BRANCHES = re.compile(
    r"(?:to_apply|true_computation|false_computation)=%([\w.-]+)|branch_computations=\{([^}]*)\}"
)
_SCRATCH = re.compile(r"[su]8\[\d*\]")  # of a library's call, among its results


class Exchange(NamedTuple):
    """Between devices."""

    operation: str  # of EXCHANGES
    size: int  # [bytes] what a device has of it before or after, whichever is more


class Loop(NamedTuple):
    """A loop of a program, or all of it, which is a loop of one turn."""

    turns: int | None  # None: the program finds out
    kernels: tuple[int, ...]  # [bytes] that each one of a turn touches, those of the loops inside left out
    inside: tuple[Loop, ...]
    exchanges: tuple[Exchange, ...] = ()  # among the kernels

    def total(self, cost: Callable[[int], float], turns: int) -> float:
        """Of the costs of all kernels in all turns, those of loops inside included.

        Args:
            cost: of a kernel, by its bytes.
            turns: of loops of unknown length.
        """
        own = sum(map(cost, self.kernels)) + sum(loop.total(cost, turns) for loop in self.inside)
        return own * (turns if self.turns is None else self.turns)

    def launches(self, turns: int) -> int:
        """How many kernels all turns have, likewise."""
        return round(self.total(lambda _: 1, turns))


def read(text: str) -> Loop:
    """The loops of a compiled program.

    Args:
        text: what `as_text()` of a compiled function gives.

    Raises:
        ValueError: it is none, or names what it has not.
    """
    computations: dict[str, list[str]] = {}
    entry, current = "", None
    for line in text.splitlines():
        if found := _COMPUTATION.match(line):
            current = computations.setdefault(found[2], [])
            entry = found[2] if found[1] else entry
        elif line.startswith("}"):
            current = None
        elif current is not None:
            current.append(line)
    if not entry:
        raise ValueError(f"HLO: expected an ENTRY computation, got {text[:60]!r} ...")
    try:
        return _loop(computations, [entry], 1)
    except KeyError as error:
        raise ValueError(f"HLO: expected a computation or an instruction called {error}") from error


def _loop(computations: Mapping[str, Sequence[str]], names: Sequence[str], turns: int | None) -> Loop:
    """A loop whose turn is made of these computations."""
    kernels: list[int] = []
    inside: list[Loop] = []
    exchanges: list[Exchange] = []
    for name in names:
        size: dict[str, int] = {}  # of results [bytes]
        for found in filter(None, map(_INSTRUCTION.match, computations[name])):
            result, kind, operation, rest = found.groups()
            size[result] = _bytes(_SCRATCH.sub("", kind) if operation == "custom-call" else kind)
            if operation == "while":
                inside.append(_while(computations, rest))
            elif operation in ("call", "conditional"):
                branch = max(
                    (_loop(computations, [branch], 1) for branch in _branches(rest)),
                    key=lambda branch: branch.launches(1),
                )
                kernels += branch.kernels
                inside += branch.inside
                exchanges += branch.exchanges
            elif operation not in NO_KERNEL and not operation.endswith("-done"):
                operands = re.findall(r"%([\w.-]+)", rest[: rest.index(")")])
                given = sum(size[x] for x in operands)
                kernels.append(size[result] + given)
                if (exchange := operation.removesuffix("-start")) in EXCHANGES:
                    made = size[result] - given * kind.startswith("((")  # what was given is in such a result
                    exchanges.append(Exchange(exchange, max(given, made)))
    return Loop(turns, tuple(kernels), tuple(inside), tuple(exchanges))


def _while(computations: Mapping[str, Sequence[str]], rest: str) -> Loop:
    """A loop by its instruction; where the number of turns is known, its condition is not computed."""
    body, condition = (re.search(rf"{part}=%([\w.-]+)", rest) for part in ("body", "condition"))
    turns = _TURNS.search(rest)
    if not body or not condition:
        raise ValueError(f"HLO: expected body and condition of a while, got {rest[:60]!r} ...")
    if turns:
        return _loop(computations, [body[1]], int(turns[1]))
    return _loop(computations, [body[1], condition[1]], None)


def _branches(rest: str) -> list[str]:
    """Names of the computations of which one is done."""
    named = ",".join(one or several for one, several in _BRANCHES.findall(rest))
    return [name.strip(" %") for name in named.split(",")]


def _bytes(kind: str) -> int:
    """Of an array's type, or of all of a tuple's."""
    return sum(
        math.prod(map(int, filter(None, shape.split(",")))) * int(bits or 8) // 8
        for _, bits, shape in _ARRAY.findall(kind)
    )
