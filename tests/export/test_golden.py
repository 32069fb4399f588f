"""Golden rows: what they meet, the file they stand in, and the agreement of NumPy and JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.safety import MOVING_WINDOWS, REST_WINDOWS, Fault
from mjx_softarm.export import computations
from mjx_softarm.export import golden as golden_rows
from mjx_softarm.export.__main__ import main
from mjx_softarm.export.check import TOLERANCE, check, compare, without_memory
from mjx_softarm.export.golden import BITS, FLAGS, read_golden, write_golden
from mjx_softarm.policy import reach
from mjx_softarm.policy.runtime import InMotion
from tests.export.conftest import N_SINGLE, few_golden_rows
from tests.linear_arm import N

pytestmark = pytest.mark.usefixtures("quick_compiler")


def test_rows_meet_faults_and_vent(golden, controller):
    faults = golden.outputs[:, 0].astype(int)
    met = {fault for fault, bit in BITS.items() if np.any(faults & bit)}
    assert met == set(Fault)
    assert len(golden.inputs) > N_SINGLE == np.count_nonzero(golden.inputs[:N_SINGLE, 0])
    begins = np.flatnonzero(golden.inputs[:, 0])
    lost = np.flatnonzero(faults & BITS[Fault.CHAMBER_LOST])
    # Ticks after the leak
    at_rest, in_motion = lost - begins[np.searchsorted(begins, lost, "right") - 1] - 60
    assert REST_WINDOWS * controller.window <= at_rest < MOVING_WINDOWS * controller.window <= in_motion
    stopped = np.flatnonzero(faults & BITS[Fault.SENSOR_STUCK])[0]
    pressure_kpa = golden.outputs[stopped:, 2 : 2 + N]
    ramp = np.abs(pressure_kpa[: np.flatnonzero(golden.inputs[stopped + 1 :, 0])[0] + 1])
    assert ramp[0].max() > 1.0 and not ramp[-1].any() and (np.diff(ramp, axis=0) <= 1e-9).all()


def test_jax_agrees_on_all_single_rows(golden, controller):
    unknown, zeros = jnp.full(N, jnp.nan), jnp.zeros(N)
    motion = InMotion(unknown, unknown, zeros)

    @jax.jit
    def answer(readings, goal):
        return computations.answer(controller, readings, goal, unknown, 0.0, zeros, zeros, motion)

    rows, outputs = without_memory(golden, answer)
    agreement = compare(golden, rows, outputs)
    assert agreement.n_rows >= N_SINGLE and agreement.error < TOLERANCE, agreement


def test_jax_agrees_on_checked_goals(golden, controller):
    rows, policy = np.flatnonzero(golden.inputs[:, FLAGS.index("checked")]), controller.policy
    refused = golden.outputs[rows, 0].astype(int) & BITS[Fault.GOAL_OUTSIDE] > 0
    assert 10 < refused.sum() < len(rows) - 10
    goals = jnp.asarray(golden.inputs[rows, -6:])

    @jax.jit
    def error():
        start = jnp.asarray(reach.begin(policy, len(rows)))
        step = lambda _, search: reach.improve(policy, goals, search)  # noqa: E731
        return reach.nearest_of(policy, goals, jax.lax.fori_loop(0, reach.N_STEPS, step, start))[1]

    np.testing.assert_array_equal(error() > policy.reward.threshold, refused)


def test_command_checks_a_policy_file(golden, policy_file, tmp_path, capsys):
    some = slice(N_SINGLE - 50, N_SINGLE + 100)  # single rows, checked ones, and the beginning of a run
    write_golden(
        tmp_path / "golden.csv", golden._replace(inputs=golden.inputs[some], outputs=golden.outputs[some])
    )
    assert main(["check", str(tmp_path / "golden.csv"), str(policy_file)]) == 0
    assert "150 rows agree" in capsys.readouterr().out
    column = np.arange(golden.outputs.shape[1]) == golden.output_columns().index("reference1")
    other = golden._replace(inputs=golden.inputs[:20], outputs=golden.outputs[:20] + 1e-3 * column)
    write_golden(tmp_path / "golden.csv", other)
    assert main(["check", str(tmp_path / "golden.csv"), str(policy_file)]) == 1
    assert "DO NOT AGREE" in (out := capsys.readouterr().out) and "reference1" in out


def test_file_gives_rows_back_and_damaged_ones_are_refused(golden, policy_file, tmp_path):
    path = tmp_path / "golden.csv"
    write_golden(path, golden)
    found = read_golden(path)
    np.testing.assert_array_equal(found.inputs, golden.inputs)
    np.testing.assert_allclose(found.outputs, golden.outputs, rtol=1e-8, atol=1e-12)
    data = path.read_bytes()
    for spoilt in (data[:-1000], data.replace(b"0.2", b"0.3", 1), b"", b"time [s],pressure0 [kPa]\n"):
        path.write_bytes(spoilt)
        with pytest.raises(InputError, match="without their checksum, expected an unchanged file"):
            read_golden(path)
    newer = golden._replace(about=golden.about | {"schema_version": 3})
    write_golden(path, newer)
    with pytest.raises(InputError, match="schema_version: got 3, expected 2; export the run again"):
        read_golden(path)
    other = golden._replace(about=golden.about | {"policy_sha256": "0" * 64})
    with pytest.raises(InputError, match="got policy [0-9a-f]{12}, expected 000000000000"):
        check(other, policy_file)


def test_fault_that_differs_is_infinitely_off(golden):
    faults = golden.outputs[:, 0].copy()
    faults[7] += 1
    agreement = compare(golden, np.arange(len(faults)), {"faults": faults})
    assert (agreement.error, agreement.column, agreement.row) == (np.inf, "faults", 7)
    turned = golden.outputs[:, -1] + 360.0
    assert compare(golden, np.arange(len(faults)), {"pose_roll": turned}).error < TOLERANCE


def test_a_run_ends_where_rounding_has_added_up(controller, monkeypatch):
    with few_golden_rows():
        whole = golden_rows.make_golden(controller, "ab")
        monkeypatch.setattr(golden_rows, "_ROUNDED", 1e-8)
        cut = golden_rows.make_golden(controller, "ab")
    assert golden_rows.N_CHECKED < len(cut.inputs) < len(whole.inputs)
