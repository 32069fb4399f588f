"""The base of all errors that a user can put right, and the error of a missing optional package."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator


class InputError(ValueError):
    """An input that cannot be used; the message names the input, what was got and what was expected."""


@contextlib.contextmanager
def needing(extra: str, where: str) -> Iterator[None]:
    """Import packages of an optional extra of this project, such as `onnx`, within this context.

    Raises:
        InputError: a package is missing; the message begins with `where`.
    """
    try:
        yield
    except ImportError as error:
        expected = f"pip install -e '.[{extra}]' in the checkout"
        raise InputError(f"{where}: got no {error.name}, expected {expected}") from error
