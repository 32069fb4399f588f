"""Logs as files: what is written is what a plain reader finds, whole or not at all."""

import contextlib
import csv

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from mjx_softarm.logs.checks import LogError
from mjx_softarm.logs.files import read_matrix
from mjx_softarm.logs.schema import Log, write_log
from mjx_softarm.spec import ArmSpec
from tests.properties import damaged, few

STRUCTURE = {"n_sections": 2, "chambers_per_section": 6, "springs_per_section": 3}
ARM = ArmSpec.default().replace(structure=STRUCTURE)  # two sections: 12 chambers, 6 springs

WIRE = {"kind": "draw_wire", "m_per_v": 0.2, "voltage_min_v": 0.05, "voltage_max_v": 4.95}


def small_log(**changes):
    rng = np.random.default_rng(0)
    values = {
        "time_s": 0.02 * np.arange(4),
        "readings": 4e6 + rng.uniform(size=(4, 6)),
        "spring_m": rng.uniform(0.1, 0.3, (4, 6)),
        "tip_quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (4, 1)),
        "marker_m": rng.uniform(-1.0, 0.0, (4, 2, 3)),
        "payload_kg": np.full(4, 0.105),
        "goal": rng.uniform(-90.0, 90.0, (4, 6)),
    }
    return Log(source="small", row=np.arange(4) + 2, **(values | changes))


def test_csv_is_what_a_plain_reader_expects(tmp_path):
    log = small_log()
    write_log(tmp_path / "log.csv", log)
    with (tmp_path / "log.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    expected = {
        "time [s]": 0.02 * np.arange(4),
        "frequency5 [Hz]": log.readings[:, 5],
        "spring2 [mm]": 1e3 * log.spring_m[:, 2],
        "tip_qw [1]": np.ones(4),
        "marker1_y [mm]": 1e3 * log.marker_m[:, 1, 1],
        "payload [g]": np.full(4, 105.0),
        "goal_x [mm]": log.goal[:, 0],
        "goal_roll [deg]": log.goal[:, 5],
    }
    for name, values in expected.items():
        np.testing.assert_allclose([float(row[name]) for row in rows], values, rtol=1e-8, err_msg=name)


def test_failed_write_leaves_the_old_file_and_no_part(tmp_path, monkeypatch):
    def fail(file, *_, **__):
        file.write(b"time [s]\n0.0")
        raise OSError(28, "No space left on device")

    path = tmp_path / "log.csv"
    path.write_text("old")
    monkeypatch.setattr(np, "savetxt", fail)
    with pytest.raises(OSError, match="No space left"):
        write_log(path, small_log())
    assert path.read_text() == "old"
    assert [item.name for item in tmp_path.iterdir()] == ["log.csv"]


def numbers(*shape):
    return npst.arrays(float, shape, elements=st.floats(-1e30, 1e30))


@few
@given(
    groups=st.fixed_dictionaries(
        {"readings": numbers(4, 6)},
        optional={
            "spring_m": numbers(4, 6),
            "pressure_kpa": numbers(4, 12),
            "tip_m": numbers(4, 3),
            "goal": numbers(4, 6),
        },
    ),
    reading_name=st.sampled_from(("frequency", "voltage")),
    name=st.sampled_from(("log.csv", "log.npz")),
)
def test_any_log_is_written_and_read_again(tmp_path, groups, reading_name, name):
    log = Log("any", np.arange(4) + 2, 0.02 * np.arange(4), reading_name=reading_name, **groups)
    write_log(tmp_path / name, log)
    arm = ARM if reading_name == "frequency" else ARM.replace(sensor=WIRE | {"beta": 1.0, "delta_m": 0.0})
    matrix, findings = read_matrix(tmp_path / name, arm)
    again = matrix.log()
    assert not findings and again.reading_name == reading_name
    for group in ("time_s", *groups):
        np.testing.assert_allclose(getattr(again, group), getattr(log, group), rtol=1e-8)
    assert again.payload_kg is None


@settings(few, max_examples=200)
@given(data=st.data(), name=st.sampled_from(("log.csv", "log.npz")))
@pytest.mark.filterwarnings("error")
def test_a_damaged_log_is_read_or_refused(tmp_path, data, name):
    write_log(tmp_path / name, small_log())
    (tmp_path / name).write_bytes(data.draw(damaged((tmp_path / name).read_bytes())))
    with contextlib.suppress(LogError):
        assert len(read_matrix(tmp_path / name, ARM)[0].log()) > 0
