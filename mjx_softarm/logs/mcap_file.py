"""Logs in Foxglove's format MCAP: one topic for each part of a log, its messages JSON with a schema.

The topic `/pressure_kpa` has a message `{"pressure0": -12.5, ...}` for each row. Units are those of the CSV
file, and the schema names them. A missing or infinite value is null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import groupby
from typing import BinaryIO

import numpy as np

SUFFIX = ".mcap"
_PROFILE, _ENCODING, _LIBRARY = "", "json", "mjx_softarm"


def write_mcap(file: BinaryIO, columns: Sequence[tuple[str, str, str]], table: np.ndarray) -> None:
    """Write a log.

    Args:
        file: opened for writing.
        columns (k,): topic, name and unit of each column; the first is the time.
        table (rows, k): numbers in these units.
    """
    from mcap.writer import Writer

    writer = Writer(file)
    writer.start(_PROFILE, _LIBRARY)
    # Register each topic, with the places of its columns.
    topics = []
    for topic, members in groupby(range(1, len(columns)), lambda k: columns[k][0]):
        places = list(members)
        schema_id = writer.register_schema(topic, "jsonschema", _schema([columns[k] for k in places]))
        topics.append((writer.register_channel(f"/{topic}", _ENCODING, schema_id), places))
    # Write one message a row into each topic.
    for sequence, row in enumerate(table):
        time_ns = round(1e9 * row[0])
        for channel_id, places in topics:
            values = {columns[k][1]: float(row[k]) if math.isfinite(row[k]) else None for k in places}
            data = json.dumps(values).encode()
            writer.add_message(channel_id, time_ns, data, publish_time=time_ns, sequence=sequence)
    writer.finish()


def _schema(columns: Sequence[tuple[str, str, str]]) -> bytes:
    """Return the JSON schema of a topic's messages."""
    numbers = {name: {"type": ["number", "null"], "description": f"[{unit}]"} for _, name, unit in columns}
    return json.dumps({"type": "object", "properties": numbers}).encode()
