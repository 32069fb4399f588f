"""Logs in Foxglove's format MCAP: one topic for each part of a log, its messages JSON with a schema.

The topic `/pressure_kpa` has a message `{"pressure0": -12.5, ...}` for each row, in units as in the CSV file;
the schema names them. A missing or infinite value is null. Times count from the log's first row.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from mjx_softarm._support.errors import InputError

if TYPE_CHECKING:
    from mjx_softarm.logs.schema import Column

SUFFIX = ".mcap"
_PROFILE, _ENCODING, _LIBRARY = "", "json", "mjx_softarm"


def require_mcap(where: str) -> None:
    """Refuse a log of this format where the package that writes it is missing.

    Raises:
        InputError: it is; the message begins with `where`.
    """
    try:
        import mcap  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"{where}: got no {error.name}, expected pip install -e '.[mcap]' in the checkout"
        ) from error


def write_mcap(file: BinaryIO, columns: Sequence[Column], table: np.ndarray) -> None:
    """Write a log's columns (k,), time first, and numbers (rows, k) in their units."""
    from mcap.writer import Writer

    writer = Writer(file)
    writer.start(_PROFILE, _LIBRARY)
    topics = []
    for group, members in groupby(range(1, len(columns)), lambda k: columns[k].group):
        places = list(members)
        schema_id = writer.register_schema(group, "jsonschema", _schema([columns[k] for k in places]))
        topics.append((writer.register_channel(f"/{group}", _ENCODING, schema_id), places))
    for sequence, row in enumerate(table):
        time_ns = round(1e9 * row[0])
        for channel_id, places in topics:
            values = {columns[k].name: float(row[k]) if math.isfinite(row[k]) else None for k in places}
            data = json.dumps(values).encode()
            writer.add_message(channel_id, time_ns, data, publish_time=time_ns, sequence=sequence)
    writer.finish()


def _schema(columns: Sequence[Column]) -> bytes:
    """Return the JSON schema of a topic's messages."""
    numbers = {
        column.name: {"type": ["number", "null"], "description": f"[{column.unit}]"} for column in columns
    }
    return json.dumps({"type": "object", "properties": numbers}).encode()
