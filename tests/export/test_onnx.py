"""ONNX graphs in onnxruntime."""

import json

import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.goals import with_goal
from mjx_softarm.deploy.loop import start, step
from mjx_softarm.export import computations
from mjx_softarm.export.check import TOLERANCE, check
from mjx_softarm.export.golden import FLAGS, read_golden
from mjx_softarm.export.write import export_onnx
from mjx_softarm.policy.file import load_policy, save_policy
from mjx_softarm.policy.runtime import PolicyRunner, actor_output
from tests.arms import SIX_CHAMBERS
from tests.export.conftest import N_SINGLE, carrying_policy, draw_wire_policy, few_golden_rows, moving_policy
from tests.linear_arm import N

onnx = pytest.importorskip("onnx", reason="the package onnx is not installed")
onnx_files = pytest.importorskip("mjx_softarm.export.onnx_files")
ort = pytest.importorskip("onnxruntime", reason="the package onnxruntime is not installed")


@pytest.fixture(scope="module")
def files(policy_file):
    with few_golden_rows():
        return export_onnx(policy_file)


def test_graph_agrees_on_golden_rows(files, golden):
    agreement = check(golden, files[0])
    assert agreement.n_rows >= N_SINGLE and agreement.error < TOLERANCE, agreement


def test_graph_that_checks_goals_agrees(files, golden):
    agreement = check(golden, files[2])
    assert agreement.n_rows == np.count_nonzero(golden.inputs[:, FLAGS.index("checked")]) > 20
    assert agreement.error == 0.0, agreement


def test_graphs_need_opset_17_and_say_what_they_are(files, controller):
    model = onnx.load(files[0])
    assert [(item.domain, item.version) for item in model.opset_import] == [("", 17)]
    types = {item.type.tensor_type.elem_type for item in (*model.graph.input, *model.graph.output)}
    assert types <= {onnx.TensorProto.FLOAT, onnx.TensorProto.BOOL}
    about = json.loads({item.key: item.value for item in model.metadata_props}["mjx_softarm"])
    assert ArmSpec.from_dict(about["spec"], "metadata") == controller.policy.spec  # to the last digit
    assert about["inputs"]["readings"]["unit"] == "Hz" and about["rate_hz"] == controller.policy.rate_hz
    assert {item.name for item in model.graph.output} <= about["outputs"].keys()


def test_actor_alone(files, controller):
    session = ort.InferenceSession(files[1])
    observation = np.random.default_rng(0).normal(size=18).astype(np.float32)
    [action] = session.run(None, {"observation": observation})
    np.testing.assert_allclose(action, actor_output(controller.policy, observation), atol=1e-6)
    assert np.ptp(action) > 0.1


def test_lost_reading_holds_the_last_length(files, golden, controller):
    session = ort.InferenceSession(files[0])
    row = np.flatnonzero(np.isfinite(golden.outputs[:N_SINGLE]).all(axis=1))[0]
    readings, goal = np.split(golden.inputs[row, len(FLAGS) :].copy(), [N])
    last_m = np.linspace(0.15, 0.2, N)
    readings[3] = np.nan
    feed = {"readings": readings, "goal": goal, "last_length_m": last_m}
    names = ["reference_m", "length_m", "reading_lost"]
    got = session.run(names, {name: np.asarray(value, np.float32) for name, value in feed.items()})
    assert got[1][3] == np.float32(0.15 + 3 * 0.05 / 8) and np.flatnonzero(got[2]).tolist() == [3]
    # The loop does not act while a reading is lost; with the same lengths read, it asks for the same.
    readings[3] = controller.policy.sensor.readings(last_m)[3]
    state, _ = with_goal(start(controller), goal)
    state, _ = step(state, readings, False)
    np.testing.assert_allclose(got[0], state.command.reference_m, atol=1e-6)


def agreeing_graph(policy, path):
    """Controller and whole graph of a policy that is saved there; the graph agrees on golden rows."""
    save_policy(path, policy)
    controller = Controller.of(load_policy(path))
    with few_golden_rows():
        whole, *_, golden = export_onnx(path)
    agreement = check(read_golden(golden), whole)
    assert agreement.n_rows >= 40 and agreement.error < TOLERANCE, agreement
    return controller, whole


def test_draw_wires_without_a_sim_to_real_network(tmp_path):
    agreeing_graph(draw_wire_policy(), tmp_path / "wires.npz")


def test_a_policy_of_motion_is_told_of_the_motion(tmp_path):
    """Without what it saw before, it answers as at its first action; with it, as the loop at its second.

    Of its arm, references and lengths are per spring, pressures and the law's integral per chamber.
    """
    controller, whole = agreeing_graph(moving_policy(SIX_CHAMBERS), tmp_path / "moving.npz")
    golden, session = read_golden(tmp_path / "moving_golden.csv"), ort.InferenceSession(whole)
    assert check(golden, tmp_path / "moving_check.onnx").error == 0.0
    assert check(golden, tmp_path / "moving.npz").holds
    items = *session.get_inputs(), *session.get_overridable_initializers(), *session.get_outputs()
    size = {item.name: item.shape for item in items}
    assert size["readings"] == size["before_m"] == size["reference_m"] == [SIX_CHAMBERS.n_springs]
    assert size["pressure_kpa"] == size["integral_kpa"] == [SIX_CHAMBERS.n_chambers]
    # The first two actions of the loop, while the springs swing
    goal = controller.policy.workspace[0].astype(float)
    state, _ = with_goal(start(controller), goal)
    swing_m = 0.18 + 0.01 * np.sin(0.3 * np.arange(20))[:, None] * np.linspace(0.5, 1.0, N)
    for spring_m in swing_m:
        before, readings = state, controller.policy.sensor.readings(spring_m)
        state, _ = step(before, readings, False)
        if state.strategy.n_actions == 2:
            break
    assert before.strategy.n_actions == 1 and state.strategy.n_actions == 2
    seen_m = controller.policy.sensor.lengths(controller.policy.sensor.readings(swing_m)).length_m
    at = len(before.belief.window_m)
    motion = {"before_m": seen_m[at - 5], "last_reference_m": before.command.reference_m}
    feed = {"readings": readings, "goal": goal, "integral_kpa": before.command.law.integral_kpa} | motion
    feed = {name: np.asarray(value, np.float32) for name, value in feed.items()}
    [reference_m] = session.run(["reference_m"], feed)
    np.testing.assert_allclose(reference_m, state.command.reference_m, atol=2e-6)
    seen_alone = {name: feed[name] for name in ("readings", "goal")}
    [blind_m] = session.run(["reference_m"], seen_alone)
    assert np.abs(blind_m - state.command.reference_m).max() > 1e-4


def test_a_policy_that_observes_the_payload_is_given_it_within_what_it_knows(tmp_path):
    controller, whole = agreeing_graph(carrying_policy(), tmp_path / "carrying.npz")
    goal = controller.policy.workspace[0].astype(float)
    readings = controller.policy.sensor.readings(np.linspace(0.17, 0.19, N))
    given = {}
    for load_kg in (0.0, 0.5, 1.0, 1.4):
        feed = {"readings": readings, "goal": goal, "load_kg": np.asarray(load_kg)}
        feed = {name: np.asarray(value, np.float32) for name, value in feed.items()}
        pose, reference_m = ort.InferenceSession(whole).run(["pose", "reference_m"], feed)
        carried_kg = np.float32([min(load_kg, 1.0)])
        expected_m = PolicyRunner(controller.policy).act(pose, goal, carried_kg).length_m
        np.testing.assert_allclose(reference_m, expected_m, atol=1e-6)
        given[load_kg] = reference_m
    assert np.abs(given[0.5] - given[0.0]).max() > 1e-3


def test_other_graphs_are_refused(files, golden, tmp_path):
    data, path = files[0].read_bytes(), tmp_path / "policy.onnx"

    def refusal(content):
        path.write_bytes(content)
        with pytest.raises(InputError, match=f"{path}: ") as caught:
            check(golden, path)
        return str(caught.value)

    cut = refusal(data[: len(data) // 2])
    assert "got no ONNX graph" in cut or "without its checksum" in cut
    assert "got no ONNX graph" in refusal(b"PK\x03\x04 something else")
    model = onnx.load_from_string(data)
    [weight] = [item for item in model.graph.initializer if tuple(item.dims) == (18, 12)]
    weight.raw_data = weight.raw_data[:-1] + bytes([weight.raw_data[-1] ^ 1])
    assert "without its checksum" in refusal(model.SerializeToString())
    del model.metadata_props[:]
    assert "of another program" in refusal(model.SerializeToString())
    assert "got actor, expected the graph" in refusal(files[1].read_bytes())


def test_newer_graph_is_refused(controller, golden, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(onnx_files, "SCHEMA_VERSION", 2)
        onnx_files.write_onnx(tmp_path / "a.onnx", computations.actor(controller), {}, {})
    with pytest.raises(InputError, match="schema_version: got 2, expected 1; `python -m train export"):
        check(golden, tmp_path / "a.onnx")
