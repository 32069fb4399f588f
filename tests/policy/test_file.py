"""The policy file: what is written is read, and nothing else is ever taken for a policy."""

import dataclasses
import hashlib
import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from mjx_softarm import ArmSpec
from mjx_softarm._support.archive import SealedFileError, sealed
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.policy import file as export
from mjx_softarm.policy.file import load_policy, policy_from_actor, save_policy
from tests.properties import few

PROVENANCE = {"commit": "0123abc", "created": "2025-01-31", "packages": {"numpy": "2.0"}, "seed": 7}
# Digest of the names that schema 3 stores and of the fields of its specification.
SCHEMA_3 = "92ad30f1"


def make_params(hidden=(7, 5), n_actions=9):
    rng = np.random.default_rng(0)
    sizes = [18, *hidden, 2 * n_actions]
    names = [*(f"hidden_{k}" for k in range(len(hidden))), "head"]
    dense = {
        name: {"kernel": rng.normal(size=(n_in, n_out)), "bias": rng.normal(size=n_out)}
        for name, n_in, n_out in zip(names, sizes[:-1], sizes[1:], strict=True)
    }
    return {"params": dense}


@pytest.fixture
def make_policy(make_arm_model):
    """Changes -> a policy with every part that a policy may have."""

    def make(**changes):
        spec = ArmSpec.default().replace(sensor={"beta": tuple(np.linspace(0.9, 0.98, 9))})
        model = make_arm_model(9, s2r=True)
        policy = policy_from_actor(make_params(), spec, RewardConfig(threshold=0.025), model, PROVENANCE)
        return dataclasses.replace(policy, **changes)

    return make


@pytest.fixture
def file(tmp_path, make_policy):
    path = tmp_path / "policy.npz"
    save_policy(path, make_policy())
    return path


def arrays_of(path):
    with np.load(path) as npz:
        return dict(npz)


def reseal(path, drop=(), **changes):
    """The file with other entries, under a checksum that fits them."""
    arrays = {name: value for name, value in arrays_of(path).items() if name not in drop}
    path.write_bytes(
        sealed(arrays | {name.replace("__", "."): v for name, v in changes.items()}, export.KIND)
    )


def assert_same(one, other):
    for item in dataclasses.fields(export.Policy):
        got, expected = getattr(one, item.name), getattr(other, item.name)
        if isinstance(expected, (tuple, np.ndarray)):
            for a, b in zip(flat(got), flat(expected), strict=True):
                np.testing.assert_array_equal(a, b, strict=True)
        else:
            assert got == expected, item.name


def flat(value):
    if dataclasses.is_dataclass(value):
        value = tuple(vars(value).values())
    return [x for part in value for x in flat(part)] if isinstance(value, tuple) else [np.asarray(value)]


def refusal(path):
    """The message with which a file is refused: one line that starts with the file's name."""
    with pytest.raises(SealedFileError) as caught:
        load_policy(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message.removeprefix(f"{path}: ")


def test_what_is_saved_is_loaded(file, make_policy):
    assert_same(load_policy(file), make_policy())
    assert load_policy(file).provenance == PROVENANCE


def test_policy_without_a_sim_to_real_network(tmp_path, make_policy):
    save_policy(tmp_path / "policy.npz", make_policy(s2r=None))
    assert_same(load_policy(tmp_path / "policy.npz"), make_policy(s2r=None))
    assert arrays_of(tmp_path / "policy.npz")["s2r_kind"] == "none"


def test_parts_are_those_of_the_arm(file):
    policy, spec = load_policy(file), ArmSpec.default()
    assert [weight.shape for weight, _ in policy.layers] == [(18, 7), (7, 5), (5, 9)]
    np.testing.assert_array_equal(policy.obs_scale.centre, [0, 0, -600, 0, 0, 0])
    np.testing.assert_array_equal(policy.obs_scale.scale, [200, 200, 200, 90, 90, 90])
    assert (policy.reward.threshold, policy.reward.weight_per_mm, policy.reward.weight_per_deg) == (
        0.025,
        0.0056,
        0.001,
    )
    assert (policy.gains.pressure_min_kpa, policy.gains.pressure_max_kpa, policy.rate_hz) == (
        -40.0,
        20.0,
        50.0,
    )
    np.testing.assert_array_equal(policy.sensor.beta, policy.spec.sensor.beta)
    # Resonance of capacitor, coil and compensation, from the paper's equations.
    for column, length_m in ((0, spec.springs.length_min_m), (1, spec.springs.length_max_m)):
        wire_m = (length_m - spec.sensor.delta_m) / np.linspace(0.9, 0.98, 9)
        coil_h = 1.26e-6 * spec.sensor.turns**2 * np.pi * spec.sensor.coil_radius_m**2 / wire_m
        total_h = coil_h + spec.sensor.compensation_h
        expected = 1.0 / (2.0 * np.pi * np.sqrt(spec.sensor.capacitance_f * total_h))
        np.testing.assert_allclose(policy.actions[1 + column], expected, rtol=1e-12)


def test_file_is_plain_npz_with_named_layouts(file):
    arrays = arrays_of(file)
    assert arrays["schema_version"] == 3 and arrays["s2r_kind"] == "mlp"
    assert arrays["obs_layout"].tolist()[:7] == [
        *("pose_x_mm", "pose_y_mm", "pose_z_mm", "pose_yaw_deg", "pose_pitch_deg", "pose_roll_deg"),
        "goal_x_mm",
    ]
    assert arrays["obs_layout"].shape == (18,) and arrays["obs_layout"][17] == "error_roll_deg"
    assert arrays["action_layout"].tolist() == [f"frequency{k}" for k in range(9)]


def test_same_policy_gives_same_bytes(file, tmp_path):
    save_policy(tmp_path / "again.npz", load_policy(file))
    assert (tmp_path / "again.npz").read_bytes() == file.read_bytes()


def test_actor_with_one_layer_and_arm_with_two_sections(tmp_path, make_arm_model):
    spec = ArmSpec.default().replace(structure={"n_sections": 2})
    policy = policy_from_actor(make_params((), 6), spec, RewardConfig(), make_arm_model(6), {})
    save_policy(tmp_path / "policy.npz", policy)
    assert_same(load_policy(tmp_path / "policy.npz"), policy)


@pytest.mark.parametrize("names", [["hidden_0"], ["hidden_1", "head"], ["hidden_0", "head", "norm_0"], []])
def test_parameters_of_another_network_are_refused(names, make_arm_model):
    dense, model = make_params()["params"]["hidden_0"], make_arm_model(9)
    with pytest.raises(ValueError, match=r"expected hidden_0, hidden_1, \.\.\. and head"):
        policy_from_actor(
            {"params": dict.fromkeys(names, dense)}, ArmSpec.default(), RewardConfig(), model, {}
        )


def test_networks_of_another_arm_are_refused(make_arm_model):
    for part in ("estimator", "spring_model", "s2r"):
        model = make_arm_model(9, s2r=True)._replace(**{part: getattr(make_arm_model(6, s2r=True), part)})
        with pytest.raises(SealedFileError, match=rf"policy: {part}\.\w+: got float32 \("):
            policy_from_actor(make_params(), ArmSpec.default(), RewardConfig(), model, {})


def test_actor_of_another_arm_is_refused(make_arm_model):
    with pytest.raises(
        SealedFileError, match=r"policy: actor.2.bias: got float32 \(6,\), expected float32 \(9,\)"
    ):
        policy_from_actor(make_params(n_actions=3), ArmSpec.default(), RewardConfig(), make_arm_model(9), {})


@settings(few, max_examples=150)
@given(data=st.data())
@pytest.mark.filterwarnings("error")
def test_any_entry_in_the_place_of_another_is_read_or_refused(file, data):
    """Under a checksum that fits: what another program may write."""
    arrays, original = arrays_of(file), file.read_bytes()
    name = data.draw(st.sampled_from(sorted(arrays)))
    dtype = data.draw(st.sampled_from((arrays[name].dtype, np.dtype("f8"), np.dtype("i8"), np.dtype("U4"))))
    shape = data.draw(st.sampled_from((arrays[name].shape, (), (3,), (0, 6))))
    reseal(file, **{name: data.draw(npst.arrays(dtype, shape))})
    try:
        assert load_policy(file).spec.n_chambers == 9
    except SealedFileError as error:
        assert str(error).startswith(f"{file}: ")
    file.write_bytes(original)


def test_files_that_are_no_policy(tmp_path):
    path = tmp_path / "other.npz"
    assert refusal(path) == "cannot be read: No such file or directory"
    assert refusal(tmp_path) == "cannot be read: Is a directory"
    for content in (b"", b"name = 'paper'\n", b"PK\x03\x04", bytes(1000)):
        path.write_bytes(content)
        assert refusal(path) == (
            f"got no complete npz archive, {len(content)} bytes, "
            "expected an unchanged file of `python -m train export`"
        )
    np.savez(path, weight=np.zeros(3))
    assert refusal(path).startswith("got an archive without a policy's mark at its end")


@pytest.mark.parametrize("version", [0, 1, 2])
def test_another_schema_is_named_before_anything_else(file, version):
    reseal(file, drop=["gains.kp_kpa_per_m"], schema_version=np.array(version), nose=np.zeros(3))
    assert refusal(file) == (
        f"schema_version: got {version}, expected 3; `python -m train export RUN` writes the policy anew"
    )


def test_every_entry_is_required(file):
    data = file.read_bytes()
    for name in arrays_of(file):
        reseal(file, drop=[name])
        assert refusal(file) == f"{name}: missing"
        file.write_bytes(data)


def test_every_number_must_be_finite(file):
    data = file.read_bytes()
    for name, array in arrays_of(file).items():
        if array.dtype.kind == "f":
            for bad in (np.nan, np.inf):
                changed = array.copy()
                changed.flat[-1] = bad
                reseal(file, **{name: changed})
                assert refusal(file) == f"{name}: got {bad}, expected finite numbers that float32 holds"
                file.write_bytes(data)


def test_every_type_and_shape_is_checked(file):
    data = file.read_bytes()
    for name, array in arrays_of(file).items():
        for changed in (array.astype("S"), array[None]):
            reseal(file, **{name: changed})
            assert refusal(file).startswith(f"{name}: got {changed.dtype.name} {changed.shape}, expected ")
            file.write_bytes(data)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actor__n_layers": np.array(0)}, "actor.n_layers: got 0, expected at least 1"),
        ({"actor__n_layers": np.array(4)}, "actor.3.bias: missing"),
        ({"actor__n_layers": np.array(2)}, "actor.1.bias: got float32 (5,), expected float32 (9,)"),
        (
            {"actor__1__weight": np.zeros((8, 5), np.float32)},
            "actor.1.weight: got float32 (8, 5), expected float32 (7, 5)",
        ),
        ({"actor__0__bias": np.zeros(7)}, "actor.0.bias: got float64 (7,), expected float32 (7,)"),
        ({"obs_layout": np.array(export.OBS_LAYOUT[::-1])}, "obs_layout: got ['error_roll_deg', "),
        ({"action_layout": np.array(["voltage0"] * 9)}, "action_layout: got ['voltage0', 'voltage0', "),
        ({"obs_scale__scale": np.zeros(6)}, "obs_scale.scale: got [0.0, "),
        ({"action__low": np.full(9, 5e6)}, "action.low: got [5000000.0, "),
        ({"action__low": np.full(9, 1.0)}, "action.low: got [1.0, "),
        ({"sensor__delta_m": np.full(9, -1.0)}, "action.low: got "),
        (
            {"gains__pressure_min_kpa": np.array(20.0)},
            "gains.pressure_min_kpa: got 20.0, expected less than gains.pressure_max_kpa",
        ),
        ({"rate_hz": np.array(0.0)}, "rate_hz: got 0.0, expected a number > 0"),
        ({"tolerance_m": np.array(-1e-3)}, "tolerance_m: got -0.001, expected a number > 0"),
        ({"n_actions": np.array(0)}, "n_actions: got 0, expected a whole number > 0"),
        ({"s2r_kind": np.array("tree")}, "s2r_kind: got tree, expected mlp or none"),
        ({"s2r_kind": np.array("none")}, "s2r.0.bias: unknown entry, schema 3 has none of this name"),
        ({"workspace": np.zeros((0, 6), np.float32)}, "workspace: got float32 (0, 6), expected "),
        ({"estimator__spring_scale_m": np.zeros(9, np.float32)}, "estimator.spring_scale_m: got [0.0, "),
        ({"s2r__limit": np.float32(0.0)}, "s2r.limit: got 0.0, expected a number > 0"),
        ({"provenance_json": np.array("[1]")}, "provenance_json: got '[1]', expected a JSON object"),
        ({"spec_json": np.array("{")}, "spec_json: got '{', expected a JSON object"),
        ({"spec_json": np.array('{"nose": 1}')}, "spec_json: nose: unknown field, expected one of name, "),
        ({"gains__kd": np.array(1.0)}, "gains.kd: unknown entry, schema 3 has none of this name"),
        ({"rate_hz": np.array([{}])}, "holds an array that cannot be read: "),
    ],
)
def test_entries_that_do_not_fit(file, changes, message):
    reseal(file, **changes)
    assert refusal(file).startswith(message)


def test_policy_that_is_not_finite_is_not_written(file, make_policy):
    before = file.read_bytes()
    layers = make_policy().layers
    layers[0][0][3, 2] = np.nan
    with pytest.raises(
        SealedFileError, match=r"actor\.0\.weight: got nan, expected finite numbers that float32 holds"
    ):
        save_policy(file, make_policy(layers=layers))
    assert file.read_bytes() == before


@pytest.mark.parametrize("step", ["write_bytes", "replace"])
def test_failed_write_keeps_the_old_file_and_leaves_nothing(file, make_policy, monkeypatch, step):
    before = file.read_bytes()

    def fail(path, *arguments):
        if step == "write_bytes":
            with path.open("wb") as part:
                part.write(b"PK")
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(type(file), step, fail)
    with pytest.raises(SealedFileError, match=r"policy\.npz: cannot be written: No space left on device"):
        save_policy(file, make_policy(rate_hz=25.0))
    assert [path.name for path in file.parent.iterdir()] == ["policy.npz"]
    assert file.read_bytes() == before


def test_places_that_cannot_be_written(file, make_policy, tmp_path):
    for path, reason in (
        (tmp_path / "nowhere" / "policy.npz", "No such file or directory"),
        (tmp_path, "Is a directory"),
        (file / "policy.npz", "Not a directory"),
    ):
        with pytest.raises(SealedFileError, match=f"{path}: cannot be written: {reason}"):
            save_policy(path, make_policy())


def test_schema_3_stays_as_it_is(file, make_policy):
    groups = make_policy().spec.to_dict().items()
    fields = [f"{name}.{item}" for name, group in groups if isinstance(group, dict) for item in group]
    names = "\n".join(sorted([*arrays_of(file), *fields]))
    digest = hashlib.sha256(names.encode()).hexdigest()[:8]
    assert digest == SCHEMA_3, "other entries, or other fields of ArmSpec: raise export.SCHEMA_VERSION"
