"""Files that are written whole or not at all, and files of JSON lines."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a path to write to, which replaces the file at the end; an error leaves the file as it was."""
    part = path.with_name(path.name + ".part")
    try:
        yield part
        part.replace(path)
    finally:
        if part.exists():  # `unlink(missing_ok=True)` fails where the parent is no folder
            part.unlink()


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """Return the objects of a file's lines, up to the first incomplete line; none without a file."""
    rows = []
    for line in path.read_text("utf-8").splitlines() if path.exists() else []:
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return rows
