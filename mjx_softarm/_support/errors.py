"""Errors that a user can put right, and codes of how a simulation ended."""

from __future__ import annotations

import contextlib
import enum
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any


class InputError(ValueError):
    """An input that cannot be used; the message names the input, what was got and what was expected."""


def check_settings(where: str, settings: Any, required: Mapping[str, tuple[Any, str]]) -> None:
    """Raise InputError for the first setting in `required` (name -> holds, expected) that does not hold."""
    for name, (holds, expected) in required.items():
        if not holds:
            raise InputError(f"{where}.{name}: got {getattr(settings, name)!r}, expected {expected}")


@contextlib.contextmanager
def needing(extra: str, where: str) -> Iterator[None]:
    """Import packages of an optional extra, which `where` needs, within this context. Raises InputError."""
    try:
        yield
    except ImportError as error:
        raise InputError(f"{where}: {missing(error, extra)}") from error


def missing(error: ImportError, extra: str) -> str:
    """Return the sentence for a package of an optional extra that cannot be imported."""
    checkout = (Path(__file__).resolve().parents[2] / "pyproject.toml").exists()
    what = f"-e '.[{extra}]' in the checkout" if checkout else f"'mjx-softarm[{extra}]'"
    return f"got no {error.name}, expected pip install {what}"


class Result(enum.IntEnum):
    """A code of how a simulation ended, an int32 in arrays, with a text for messages."""

    text: str

    def __new__(cls, code: int, text: str) -> Result:
        member = int.__new__(cls, code)
        member._value_ = code
        member.text = text
        return member
