"""Rules of the fields of a specification, and the reader that checks tables against them."""

from __future__ import annotations

import dataclasses
import functools
import math
import sys
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal, get_args, get_origin

from mjx_softarm._support.errors import InputError

PerChamber = float | tuple[float, ...]  # a number for all chambers, or one for each
PerSection = float | tuple[float, ...]  # a number for all sections, or one for each
MAX_COUNT = 100  # largest number of sections, and of links per section; more would not fit into memory
FLOAT32_MIN, FLOAT32_MAX = 1.1754944e-38, 3.4028235e38  # smallest and largest normal float32


class SpecError(InputError):
    """A specification that cannot be used; the message names file, field, value and what was expected."""


@dataclass(frozen=True)
class Rule:
    """Values that a field accepts: a kind of number, its range, and how many."""

    kind: type = float
    low: float = -math.inf
    high: float = math.inf
    low_open: bool = False
    high_open: bool = False
    per: str = ""  # parts that may have a number each, such as "chambers"
    length: int | None = None  # length of a field that must be a list; 0: one number for each part
    unit: str = ""  # unit, and the one that it is confused with, beside the upper bound

    @property
    def text(self) -> str:
        """The rule in words."""
        noun = {int: "a whole number", float: "a number", str: "a text"}[self.kind]
        low = "" if self.low == -math.inf else f" {'>' if self.low_open else '>='} {self.low:g}"
        below = "<" if self.high_open else "<="
        high = "" if self.high == math.inf else f"{' and' if low else ''} {below} {self.high:g}"
        high += f" ({self.unit})" if self.unit else ""
        if self.length is not None:
            return f"a list of {self.length} numbers" if self.length else "a list of numbers"
        each = f", or a list with one for each of the {self.per}" if self.per else ""
        return noun + low + high + each

    def accepts(self, value: Any) -> bool:
        """Return whether a value is of the kind and in the range."""
        if self.kind is str:
            return isinstance(value, str)
        if isinstance(value, bool) or not isinstance(value, (int, self.kind)):
            return False
        above = value > self.low if self.low_open else value >= self.low
        below = value < self.high if self.high_open else value <= self.high
        return above and below and abs(value) <= sys.float_info.max  # not NaN, nor a huge whole number


# Types of settings with their ranges, for `check_ranges`
Count = Annotated[int, Rule(kind=int, low=1)]
Number = Annotated[int, Rule(kind=int, low=0)]
Amount = Annotated[float, Rule(low=0.0)]
Positive = Annotated[float, Rule(low=0.0, low_open=True)]
Share = Annotated[float, Rule(low=0.0, high=1.0)]
PartialShare = Annotated[float, Rule(low=0.0, high=1.0, high_open=True)]
PositiveShare = Annotated[float, Rule(low=0.0, high=1.0, low_open=True)]


def check_ranges(where: str, settings: Any) -> None:
    """Raise InputError for a setting outside the range, or the names, of its type; None has no range.

    `where` is the path or class of the settings with a dot at its end, or empty.
    """
    hints = typing.get_type_hints(type(settings), include_extras=True)
    for item in fields(settings):
        value, hint = getattr(settings, item.name), hints[item.name]
        if value is None and type(None) in get_args(hint):
            continue
        for accepts, expected in _expectations(hint):
            if not accepts(value):
                raise InputError(f"{where}{item.name}: got {value!r}, expected {expected}")


def _expectations(hint: Any) -> Iterator[tuple[Callable[[Any], bool], str]]:
    """Yield what a type asks of a value: a test, and the test in words."""
    if get_origin(hint) is Literal:
        names = get_args(hint)
        yield names.__contains__, f"one of {names}"
    elif isinstance(hint, Rule):
        yield hint.accepts, hint.text
    elif get_origin(hint) is Annotated or type(None) in get_args(hint):
        for part in get_args(hint):
            yield from _expectations(part)


def anything(*, default: Any = dataclasses.MISSING, **rule: Any) -> Any:
    """Declare a field with the arguments of its `Rule`; by default any number."""
    return field(default=default, metadata={"rule": Rule(**rule)})


positive = functools.partial(anything, low=0.0, low_open=True)
not_negative = functools.partial(anything, low=0.0)
count = functools.partial(anything, kind=int, low=1, high=MAX_COUNT)
vector = functools.partial(anything, default=(0.0, 0.0, 0.0), length=3)
numbers = functools.partial(anything, default=(), length=0)  # one for each part; empty means zeros


def scaled(value: PerSection, factor: float) -> PerSection:
    """Return a number, or each number of a list, times a factor."""
    return tuple(factor * x for x in value) if isinstance(value, tuple) else factor * value


def read_fields(cls: type, data: Any, where: str) -> dict[str, Any]:
    """Return the keyword arguments of `cls` from a table, each checked against its rule.

    `where` begins messages: the file, and the table with a dot at its end.

    Raises:
        SpecError: a field is missing, unknown or breaks its rule.
    """
    if not isinstance(data, dict):
        raise SpecError(f"{where.rstrip('.: ')}: got {data!r}, expected a table")
    # Refuse unknown fields.
    known = [item.name for item in fields(cls)]
    for name in data:
        if name not in known:
            raise SpecError(f"{where}{name}: got an unknown field, expected {', '.join(known)}")
    # Read each field: a default, a table of its own, or numbers.
    hints = typing.get_type_hints(cls)
    values: dict[str, Any] = {}
    for item in fields(cls):
        path = where + item.name
        group: Any = hints[item.name] if dataclasses.is_dataclass(hints[item.name]) else None
        if item.name not in data:
            if item.default is not dataclasses.MISSING or item.default_factory is not dataclasses.MISSING:
                continue
            expected = "a table" if group else rule_of(item).text
            raise SpecError(f"{path}: got nothing, expected {expected}")
        value = data[item.name]
        if (kinds := item.metadata.get("kinds")) and isinstance(value, dict):
            value = dict(value)
            kind = value.pop("kind", next(iter(kinds)))
            if not isinstance(kind, str) or kind not in kinds:
                raise SpecError(f"{path}.kind: got {kind!r}, expected {' or '.join(kinds)}")
            group = kinds[kind]
        if group is not None:
            values[item.name] = group(**read_fields(group, value, path + "."))
        else:
            values[item.name] = _read_value(rule_of(item), value, path)
    return values


def wrong_counts(table: Any, counts: dict[str, int], where: str = "") -> Iterator[str]:
    """Yield what is wrong about lists whose length is not the number of the arm's parts that they describe.

    `counts` are by the names that rules have for parts; `where` is the path of the table.
    """
    for item in fields(table):
        value, rule = getattr(table, item.name), rule_of(item)
        if dataclasses.is_dataclass(value):
            yield from wrong_counts(value, counts, f"{where}{item.name}.")
            continue
        is_list = rule.per and isinstance(value, tuple) and value != item.default
        if is_list and len(value) != (n := counts[rule.per]):
            expected = f"{'one, or ' if rule.length is None else ''}one for each of the {n} {rule.per}"
            yield f"{where}{item.name}: got {len(value)} numbers, expected {expected}"


def rule_of(item: dataclasses.Field) -> Rule:
    """Return the rule of a field; a field without a rule is a text."""
    return item.metadata.get("rule", Rule(kind=str))


def _read_value(rule: Rule, value: Any, path: str) -> Any:
    many = isinstance(value, (list, tuple)) and (rule.per or rule.length is not None)
    items: Any = value if many else [value]
    if rule.length is not None and not (many and len(value) == (rule.length or len(value))):
        raise SpecError(f"{path}: got {value!r}, expected {rule.text}")
    for k, item in enumerate(items):
        if not rule.accepts(item):
            place = f"{path}[{k}]" if many else path
            raise SpecError(f"{place}: got {item!r}, expected {rule.text}")
    if rule.kind is float and not all(x == 0.0 or FLOAT32_MIN <= abs(x) <= FLOAT32_MAX for x in items):
        sizes = f"sizes from {FLOAT32_MIN:.2g} to {FLOAT32_MAX:.2g}, which float32 holds"
        raise SpecError(f"{path}: got {value!r}, expected {sizes}")
    numbers = tuple(map(rule.kind, items))
    return numbers if many else numbers[0]
