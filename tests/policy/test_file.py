"""The policy file: what is written is read, and nothing else is ever taken for a policy."""

import dataclasses
import hashlib
import os
from functools import partial

import jax
import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm._support import archive
from mjx_softarm._support.archive import SealedFileError, sealed
from mjx_softarm._support.errors import InputError
from mjx_softarm.control import allocation
from mjx_softarm.mdp.observation import layouts
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.policy import file as export
from mjx_softarm.policy.file import load_policy, policy_from_actor, save_policy
from tests.arms import FOUR_CHAMBERS, SIX_CHAMBERS

PROVENANCE = {"commit": "0123abc", "created": "2025-01-31", "packages": {"numpy": "2.0"}, "seed": 7}
# Digest of the names that schema 17 stores and of the fields of its specification.
SCHEMA_17 = "2a9326c1"
TWO_SECTIONS = ArmSpec.default().replace(structure={"n_sections": 2})


def make_params(hidden=(7, 5), n_actions=9, n_obs=18):
    rng = np.random.default_rng(0)
    sizes = [n_obs, *hidden, 2 * n_actions]
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
        model = make_arm_model(spec, s2r=True)
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


def assert_same(one, other):
    jax.tree.map(partial(np.testing.assert_array_equal, strict=True), vars(one), vars(other))


def refusal(path):
    """The message with which a file is refused: one line that starts with the file's name."""
    with pytest.raises(InputError) as caught:
        load_policy(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message.removeprefix(f"{path}: ")


def test_what_is_saved_is_loaded_and_has_the_same_bytes(file, make_policy):
    assert_same(load_policy(file), make_policy())
    before = file.read_bytes()
    save_policy(file, load_policy(file))
    assert file.read_bytes() == before
    save_policy(file, make_policy(s2r=None))
    assert_same(load_policy(file), make_policy(s2r=None))


@pytest.mark.parametrize("observation", ["pose", "payload", "motion"])
@pytest.mark.parametrize("spec", [TWO_SECTIONS, FOUR_CHAMBERS, SIX_CHAMBERS], ids=lambda spec: spec.name)
def test_other_arms_and_observations_are_kept(tmp_path, make_arm_model, spec, observation):
    """Actions and readings are per spring, pressures and the law per chamber; one layer is enough."""
    names, path = layouts(spec)[observation], tmp_path / "policy.npz"
    params, model = make_params((), spec.n_springs, len(names)), make_arm_model(spec, s2r=True)
    policy = policy_from_actor(params, spec, RewardConfig(), model, {}, observation=observation)
    save_policy(path, policy)
    again = load_policy(path)
    assert_same(again, policy)
    assert again.spec == spec and len(again.actions.low) == spec.n_springs
    assert tuple(arrays_of(path)["obs_layout"]) == again.obs_layout == names
    assert arrays_of(path)["action_layout"].tolist() == [f"frequency{k}" for k in range(spec.n_springs)]
    expected = allocation(spec)
    assert (again.gains.allocation is None) == (expected is None)
    for one, other in zip(again.gains.allocation or (), expected or (), strict=True):
        np.testing.assert_array_equal(one, other)


def test_networks_of_another_arm_are_refused(make_arm_model):
    spec = ArmSpec.default()
    model, another = make_arm_model(spec, s2r=True), make_arm_model(TWO_SECTIONS, s2r=True)
    for part in ("estimator", "load_estimator", "spring_model", "s2r"):
        mixed = model._replace(**{part: getattr(another, part)})
        with pytest.raises(SealedFileError, match=rf"policy: {part}\.[\w.]+: got float32 \("):
            policy_from_actor(make_params(), spec, RewardConfig(), mixed, {})
    with pytest.raises(SealedFileError, match=r"actor.2.bias: got float32 \(6,\), expected float32 \(9,\)"):
        policy_from_actor(make_params(n_actions=3), spec, RewardConfig(), model, {})
    with pytest.raises(SealedFileError, match=r"actor.0.weight: got float32 \(20, 7\), expected float32 "):
        policy_from_actor(make_params(n_obs=20), spec, RewardConfig(), model, {})


def test_files_that_are_no_policy(tmp_path):
    path = tmp_path / "other.npz"
    assert refusal(path) == "got 'No such file or directory', expected a file of `python -m train export`"
    expected = "expected an unchanged file of `python -m train export`"
    for content in (b"", b"name = 'paper'\n", b"PK\x03\x04", sealed({"weight": np.zeros(3)}, "s2r")):
        path.write_bytes(content)
        got = f"got {len(content)} bytes without a policy's mark at their end"
        assert refusal(path) == f"{got}, {expected}"


def test_every_entry_is_required_and_its_type_shape_and_numbers_are_checked(file, monkeypatch):
    arrays = arrays_of(file)

    def read(changes):  # without packing, which takes most of the time
        monkeypatch.setattr(archive, "read_sealed", lambda path, kind, made_by: changes)

    for name, array in arrays.items():
        read({other: value for other, value in arrays.items() if other != name})
        assert refusal(file) == f"{name}: got nothing, expected an entry"
        spoilt = [(x, f"{x.dtype.name} {x.shape}, expected ") for x in (array.astype("S"), array[None])]
        for bad in (np.nan, np.inf) if array.dtype.kind == "f" else ():
            changed = array.copy()
            changed.flat[-1] = bad
            spoilt.append((changed, f"{bad}, expected finite numbers that float32 holds"))
        for changed, message in spoilt:
            read(arrays | {name: changed})
            assert refusal(file).startswith(f"{name}: got {message}")


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("schema_version", 16, "schema_version: got 16, expected 17: export the run again, or train it anew"),
        ("actor.n_layers", 0, "actor.n_layers: got 0, expected at least 1"),
        ("observation", "force", "observation: got force, expected pose or payload or motion"),
        ("observation", "payload", "obs_layout: got ['pose_x_mm', "),
        ("action_layout", ["voltage0"] * 9, "action_layout: got ['voltage0', 'voltage0', "),
        ("s2r_kind", "none", "s2r.0.bias: got an unknown entry, expected those of schema 17"),
        ("workspace", np.zeros((0, 6), np.float32), "workspace: got float32 (0, 6), expected "),
        ("spring_model.spring_scale_m", np.zeros(9, np.float32), "spring_model.spring_scale_m: got [0.0"),
        ("provenance_json", "[1]", "provenance_json: got '[1]', expected a JSON object"),
        ("spec_json", '{"nose": 1}', "spec_json: nose: got an unknown field, expected name, "),
        ("rate_hz", [{}], "got a damaged array ("),
        ("reward.threshold", np.full(6, 0.03), "reward.threshold: got float64 (6,), expected "),
        ("reward.axes", 1.0, "reward.axes: got float64 (), expected "),
    ],
)
def test_entries_that_do_not_fit(file, entry, value, message):
    file.write_bytes(sealed(arrays_of(file) | {entry: np.array(value)}, export.KIND))
    assert refusal(file).startswith(message)


def test_failed_write_keeps_the_old_file_and_leaves_nothing(file, make_policy, monkeypatch):
    before = file.read_bytes()

    def fail(path, *arguments):
        with path.open("wb") as part:
            part.write(b"PK")
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(type(file), "write_bytes", fail)
    with pytest.raises(SealedFileError, match=r"policy\.npz: got 'No space left on device'"):
        save_policy(file, make_policy(rate_hz=25.0))
    assert [path.name for path in file.parent.iterdir()] == ["policy.npz"]
    assert file.read_bytes() == before


def test_schema_17_stays_as_it_is(file, make_policy):
    groups = make_policy().spec.to_dict().items()
    fields = [f"{name}.{item}" for name, group in groups if isinstance(group, dict) for item in group]
    names = "\n".join(sorted([*arrays_of(file), *fields]))
    digest = hashlib.sha256(names.encode()).hexdigest()[:8]
    assert digest == SCHEMA_17, "other entries, or other fields of ArmSpec: raise SCHEMA_VERSION?"


def test_the_policies_that_ship_are_small_and_one_is_calibrated():
    policy = load_policy(export.SHIPPED)
    assert policy.spec == ArmSpec.default() and policy.s2r is None
    twin = load_policy(export.SHIPPED_TWIN)
    assert twin.calibrated and twin.observation == "payload"
    assert export.SHIPPED.stat().st_size + export.SHIPPED_TWIN.stat().st_size < 2e6
