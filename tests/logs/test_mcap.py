"""Logs in MCAP, opened by the format's own reader."""

import json

import numpy as np
import pytest

from mjx_softarm.logs.schema import log_table, write_log
from tests.linear_arm import GOALS, LinearArm, go

reader = pytest.importorskip("mcap.reader", reason="the package mcap is not installed")


def test_reader_finds_every_number_with_its_unit(tmp_path):
    log = go(LinearArm(), goals=GOALS[:1], duration_s=0.5).log
    log.readings[1, 4] = np.inf
    columns, table = log_table(log)
    write_log(tmp_path / "run.mcap", log)
    found = [{} for _ in table]
    with (tmp_path / "run.mcap").open("rb") as file:
        opened = reader.make_reader(file)
        units = {}
        for schema, channel, message in opened.iter_messages():
            assert channel.topic == f"/{schema.name}" and channel.message_encoding == "json"
            units |= {
                name: item["description"] for name, item in json.loads(schema.data)["properties"].items()
            }
            found[message.sequence] |= {"time": message.log_time * 1e-9} | json.loads(
                message.data, parse_constant=pytest.fail
            )
    assert units == {column.name: f"[{column.unit}]" for column in columns[1:]}
    got = np.array([[row[column.name] for column in columns] for row in found], float)  # null is NaN
    np.testing.assert_allclose(got, np.where(np.isinf(table), np.nan, table), rtol=1e-12, atol=1e-9)
