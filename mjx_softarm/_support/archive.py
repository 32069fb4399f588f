"""Sealed files: named arrays in an npz archive with a checksum and the name of its kind. NumPy only.

The archive ends with a comment: a mark that names the file's kind, then the SHA-256 of all bytes before it.
An incomplete or changed file is refused, and a file of another kind. Any npz reader can open a sealed file.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from mjx_softarm._support.errors import InputError
from mjx_softarm._support.fields import FLOAT32_MAX
from mjx_softarm._support.files import replacing
from mjx_softarm._support.mlp import Layer

# Exceptions of NumPy and zipfile on archives that are damaged or that they do not read.
ZIP_ERRORS = (ValueError, EOFError, MemoryError, NotImplementedError)
ZIP_ERRORS += (struct.error, zipfile.BadZipFile, zlib.error)
_N_DIGEST = 64  # hexadecimal digits, the last bytes of the file


class SealedFileError(InputError):
    """A sealed file that cannot be used; the message names file and entry, what was got and expected."""


def write_sealed(path: Path, arrays: Mapping[str, Any], kind: str) -> None:
    """Write arrays by name, whole or not at all; equal arrays give equal bytes. Raises SealedFileError."""
    try:
        with replacing(path) as part:
            part.write_bytes(sealed(arrays, kind))
    except OSError as error:
        raise SealedFileError(f"{path}: got {error.strerror!r}, expected to write a file") from error


def read_sealed(path: Path, kind: str, made_by: str) -> dict[str, np.ndarray]:
    """Read the arrays of a file that the command `made_by` writes.

    Raises:
        SealedFileError: the file cannot be read, is incomplete, damaged or of another kind.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SealedFileError(f"{path}: got {error.strerror!r}, expected a file of `{made_by}`") from error
    expected = f"an unchanged file of `{made_by}`"
    # Check the mark and the checksum before anything is unpacked.
    content, digest = data[:-_N_DIGEST], data[-_N_DIGEST:]
    if not content.endswith(_mark(kind)):
        got = f"{len(data)} bytes without a {kind}'s mark at their end"
        raise SealedFileError(f"{path}: got {got}, expected {expected}")
    if hashlib.sha256(content).hexdigest().encode() != digest:
        raise SealedFileError(f"{path}: got {len(data)} bytes without their checksum, expected {expected}")
    # Unpack the arrays.
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as npz:
            return {name: np.asarray(npz[name]) for name in npz.files}
    except (OSError, *ZIP_ERRORS) as error:
        raise SealedFileError(f"{path}: got a damaged array ({error}), expected {expected}") from error


def sealed(arrays: Mapping[str, Any], kind: str) -> bytes:
    """Return the bytes of a file; mark and digest are the zip archive's comment."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.comment = _mark(kind) + bytes(_N_DIGEST)
    content = buffer.getvalue()[:-_N_DIGEST]
    return content + hashlib.sha256(content).hexdigest().encode()


def _mark(kind: str) -> bytes:
    return f"mjx_softarm {kind}, sha256 ".encode()


def entries_of(name: str, group: Any) -> dict[str, np.ndarray]:
    """Return the entries `name.field` of a dataclass or named tuple; a field `layers` has `layer_entries`."""
    entries: dict[str, Any] = {}
    for item in _field_names(type(group)):
        value = getattr(group, item)
        entries |= layer_entries(name, value) if item == "layers" else {f"{name}.{item}": value}
    return {item: np.asarray(value) for item, value in entries.items()}


def _field_names(kind: type) -> tuple[str, ...]:
    return getattr(kind, "_fields", None) or tuple(item.name for item in dataclasses.fields(kind))


def layer_entries(name: str, layers: tuple[Layer, ...]) -> dict[str, Any]:
    """Return the entries `name.n_layers`, `name.0.weight`, `name.0.bias`, ..."""
    entries: dict[str, Any] = {f"{name}.n_layers": len(layers)}
    for k, (weight, bias) in enumerate(layers):
        entries |= {f"{name}.{k}.weight": weight, f"{name}.{k}.bias": bias}
    return entries


class Entries:
    """Arrays of a file, each checked when it is taken.

    Raises SealedFileError where an entry is missing, or of the wrong type, shape or range.
    """

    def __init__(self, arrays: Mapping[str, np.ndarray], source: str):
        self._source, self._arrays, self._left = source, arrays, set(arrays)

    def fail(self, name: str, problem: str) -> NoReturn:
        raise SealedFileError(f"{self._source}: {name}: {problem}")

    def take(self, name: str, kind: type, *shapes: tuple[int | None, ...]) -> Any:
        """Return a finite array in one of the `shapes`, None for any size from 1; a scalar as Python's."""
        if name not in self._arrays:
            self.fail(name, "got nothing, expected an entry")
        array = self._arrays[name]
        self._left.discard(name)
        expected = f"{kind.__name__.rstrip('_')} {' or '.join(map(_shape_text, shapes))}"
        if not np.issubdtype(array.dtype, kind) or not any(_fits(array.shape, shape) for shape in shapes):
            self.fail(name, f"got {array.dtype.name} {array.shape}, expected {expected}")
        if np.issubdtype(kind, np.floating) and not (held := np.abs(array) <= FLOAT32_MAX).all():
            self.fail(name, f"got {array[~held][0]}, expected finite numbers that float32 holds")
        return array if array.shape else array.item()

    def one_of(self, name: str, choices: tuple[str, ...]) -> Any:
        """Return a text that is one of the choices."""
        text = self.take(name, np.str_, ())
        if text not in choices:
            self.fail(name, f"got {text}, expected {' or '.join(choices)}")
        return text

    def names(self, name: str, expected: tuple[str, ...]) -> None:
        """Take a list of names, which has to be the expected one."""
        names = self.take(name, np.str_, (None,)).tolist()
        if names != list(expected):
            self.fail(name, f"got {names}, expected {list(expected)}")

    def group(self, name: str, kind: type, *shapes: tuple[int, ...]) -> Any:
        """Return a dataclass or named tuple of numbers, each in one of the `shapes`."""
        return kind(*(self.take(f"{name}.{item}", np.float64, *shapes) for item in _field_names(kind)))

    def table(self, name: str) -> dict[str, Any]:
        """Return a JSON object."""
        text = self.take(name, np.str_, ())
        try:
            return {**json.loads(text)}
        except (ValueError, TypeError, RecursionError):
            self.fail(name, f"got {text[:60]!r}, expected a JSON object")

    def layers(self, name: str, n_inputs: int, n_outputs: int) -> tuple[Layer, ...]:
        """Return the layers, one or more, of a network with n_inputs and n_outputs."""
        layers, n_layers = [], self.take(f"{name}.n_layers", np.integer, ())
        if n_layers < 1:
            self.fail(f"{name}.n_layers", f"got {n_layers}, expected at least 1")
        for k in range(n_layers):
            width = n_outputs if k == n_layers - 1 else np.size(self._arrays.get(f"{name}.{k}.bias", 0))
            bias = self.take(f"{name}.{k}.bias", np.float32, (width,))
            layers.append((self.take(f"{name}.{k}.weight", np.float32, (n_inputs, width)), bias))
            n_inputs = width
        return tuple(layers)

    def network(
        self, name: str, kind: type, layers: tuple[int, int] | None = None, **shapes: tuple[int | None, ...]
    ) -> Any:
        """Return a named tuple of float32 arrays and, with numbers of inputs and outputs, of `layers`.

        Fields with `_scale` in their names must be > 0.
        """
        values: dict[str, Any] = {}
        for item, shape in shapes.items():
            value = values[item] = np.asarray(self.take(f"{name}.{item}", np.float32, shape), np.float32)
            if "_scale" in item and not (value > 0.0).all():
                self.fail(f"{name}.{item}", f"got {value.tolist()}, expected numbers > 0")
        if layers is not None:
            values["layers"] = self.layers(name, *layers)
        return kind(**values)

    def finish(self, schema: int) -> None:
        """Refuse entries that nobody took."""
        if self._left:
            self.fail(min(self._left), f"got an unknown entry, expected those of schema {schema}")


def _fits(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    same = (n > 0 if m is None else n == m for n, m in zip(shape, expected, strict=False))
    return len(shape) == len(expected) and all(same)


def _shape_text(shape: tuple[int | None, ...]) -> str:
    return str(tuple("any" if n is None else n for n in shape)).replace("'", "")
