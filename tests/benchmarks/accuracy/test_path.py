"""The circle in time and stop by stop, as `python -m benchmarks path` measures it."""

import json
from pathlib import Path

import pytest

from benchmarks.accuracy.path import measure
from mjx_softarm._support.errors import InputError
from mjx_softarm.policy.file import SHIPPED


def test_a_policy_is_measured_in_time_and_at_stops():
    figures = measure((SHIPPED,), seconds=(4.0,), points=4, stops=2)
    [in_time], [stopping] = figures["in time"], figures["stop by stop"]
    assert json.dumps(figures) and in_time["policy"] == stopping["policy"] == "paper"
    assert in_time["once around [s]"] == 4.0 < stopping["seconds"] and stopping["mean [mm]"] > 0.0
    assert in_time["mean without that [mm]"] <= in_time["mean [mm]"] < in_time["largest [mm]"] < 200.0


def test_no_policies_and_one_that_cannot_be_measured_are_named(tmp_path):
    with pytest.raises(InputError, match="--policies: got none, expected files"):
        measure(())
    with pytest.raises(InputError, match="measure absent.npz .*: got exit status 2, expected 0 or 1"):
        measure((Path("absent.npz"),))
