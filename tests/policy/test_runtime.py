"""The deployed policy against the one that was trained; NumPy alone in its process."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm._support.mlp import ACTIVATIONS
from mjx_softarm.deploy import PolicyRunner, load_policy
from mjx_softarm.env import ReachEnv
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.mechanics.workspace import Pool
from mjx_softarm.policy.file import policy_from_actor, save_policy
from train.agent.networks import Actor, mode

N = 1000
WITH_NUMPY_ALONE = """
import sys

class Refusing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] not in {"mjx_softarm", "numpy", *sys.stdlib_module_names}:
            raise ImportError(f"{name} is refused")

sys.meta_path.insert(0, Refusing())
import importlib
from mjx_softarm.deploy import PolicyRunner, load_policy

for name in ("session", "record", "measure", "budget", "capture", "drivers.names", "drivers.ldc1612"):
    importlib.import_module(f"mjx_softarm.deploy.{name}")
reference = PolicyRunner(load_policy(sys.argv[1])).act([0, 0, -600, 0, 0, 0], [50, 0, -580, 0, 0, 0])
assert reference.length_m.shape == (9,)
"""


@pytest.fixture(scope="module")
def spec():
    """An arm whose springs all differ."""
    return ArmSpec.default().replace(
        sensor={"beta": tuple(np.linspace(0.9, 0.98, 9)), "delta_m": tuple(np.linspace(-0.002, 0.003, 9))}
    )


@pytest.fixture(scope="module")
def actor_params():
    """The default actor, its parameters disturbed so that biases count and actions fill [-1, 1]."""
    params = Actor(9).init(jax.random.key(0), jnp.zeros(18))
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    changes = [0.05 * jax.random.normal(key, x.shape) for x, key in zip(leaves, keys, strict=True)]
    return tree.unflatten(map(jnp.add, leaves, changes))


@pytest.fixture(scope="module", params=ACTIVATIONS)
def file(spec, actor_params, make_arm_model, tmp_path_factory, request):
    path, model = tmp_path_factory.mktemp("export") / "policy.npz", make_arm_model(spec)
    policy = policy_from_actor(actor_params, spec, RewardConfig(), model, {}, activation=request.param)
    save_policy(path, policy)
    return path


@pytest.fixture(scope="module")
def runner(file):
    return PolicyRunner(load_policy(file))


@pytest.fixture(scope="module")
def poses():
    """Poses and goals (N, 6) [mm, deg], wider than the arm's workspace, all angles among them."""
    rng = np.random.default_rng(2)
    low, high = [-300, -300, -750, -180, -90, -180], [300, 300, -300, 180, 90, 180]
    return rng.uniform(low, high, (2, N, 6)).astype(np.float32)


def test_an_arm_s_computer_needs_numpy_alone(file):
    command, root = [sys.executable, "-c", WITH_NUMPY_ALONE, file], Path(__file__).resolve().parents[2]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_equals_actor_and_environment_in_jax(spec, actor_params, runner, poses, monkeypatch):
    nowhere = Pool(*[np.zeros((1, 6))] * 4)  # the arm does not move here
    monkeypatch.setattr("mjx_softarm.env.reach.sample_workspace", lambda *_: nowhere)
    env = ReachEnv(spec)
    actor = Actor(9, activation=runner.policy.activation)
    action = mode(actor.apply(actor_params, env.observe(*map(jnp.asarray, poses)))[0])
    reference = runner.act(*poses)
    assert np.min(action) < -0.9 and np.max(action) > 0.9 and np.ptp(action, axis=0).min() > 0.5
    np.testing.assert_allclose(runner.action(*poses), action, rtol=0, atol=1e-5)
    np.testing.assert_allclose(reference.length_m, env.reference_m(action), rtol=0, atol=1e-5)
    np.testing.assert_allclose(env.action_of(jnp.asarray(reference.length_m)), action, rtol=0, atol=1e-5)
    _, low, high = env.action_map
    np.testing.assert_allclose(runner.policy.actions[1:], [low, high], rtol=1e-6)
    expected = low + 0.5 * (np.asarray(action) + 1.0) * (high - low)
    np.testing.assert_allclose(reference.readings, expected, rtol=1e-6)


def test_one_pose_and_a_batch_agree(runner, poses):
    batch = runner.act(*poses)
    one = runner.act(poses[0, 3].tolist(), poses[1, 3].tolist())
    assert one.readings.shape == one.length_m.shape == (9,)
    np.testing.assert_allclose(one.length_m, batch.length_m[3], rtol=1e-6)
    to_one_goal = runner.act(poses[0].reshape(10, 100, 6), poses[1, 3])
    assert to_one_goal.length_m.shape == (10, 100, 9)
    np.testing.assert_allclose(to_one_goal.length_m[0, 3], one.length_m, rtol=1e-6)


@pytest.mark.parametrize("name", ["pose", "goal"])
@pytest.mark.parametrize(
    ("value", "message"), [(np.zeros(3), r"got shape \(3,\)"), (np.full(6, np.nan), "got nan, expected")]
)
def test_malformed_pose_or_goal_is_refused(runner, name, value, message):
    arguments = {"pose": np.zeros(6), "goal": np.zeros(6)} | {name: value}
    with pytest.raises(ValueError, match=f"{name}: {message}"):
        runner.act(**arguments)


@pytest.mark.parametrize(
    ("observation", "n_more", "sensed", "message"),
    [
        ("pose", 0, [0.5], r"got shape \(1,\), expected None: the policy observes the pose"),
        ("payload", 1, None, r"got None, expected .* the policy observes the payload"),
        ("motion", 39, None, r"got None, expected .* the policy observes the motion"),
    ],
)
def test_what_is_sensed_must_be_what_the_policy_observes(runner, observation, n_more, sensed, message):
    first, *others = runner.policy.layers
    wider = np.zeros((18 + n_more, first[0].shape[1]), np.float32), first[1]
    policy = dataclasses.replace(runner.policy, layers=(wider, *others), observation=observation)
    with pytest.raises(ValueError, match=f"sensed: {message}"):
        PolicyRunner(policy).act(np.zeros(6), np.zeros(6), sensed)
    if n_more:
        many = PolicyRunner(policy).act(np.zeros((4, 6)), np.zeros(6), np.zeros(n_more))
        assert many.length_m.shape == (4, 9)


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_actor_that_overflows_is_refused(runner):
    layers = tuple((np.float32(1e30) * weight, bias) for weight, bias in runner.policy.layers)
    with pytest.raises(ValueError, match="action: got nan, expected finite numbers; the actor overflows"):
        PolicyRunner(dataclasses.replace(runner.policy, layers=layers)).act(np.full(6, 100.0), np.zeros(6))
