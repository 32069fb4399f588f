"""A user's own learner, handed to the epoch: trained, evaluated and exported like any other."""

import dataclasses
import io
import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from rich.console import Console

from calib.arm import CalibratedArm
from mjx_softarm._support.errors import InputError
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.policy.file import load_policy
from tests.arms import SHORT
from train.agent.hindsight import HindsightConfig
from train.agent.imitation import ImitationConfig
from train.agent.networks import Actor
from train.agent.tqc import TQCConfig
from train.config import LEARNERS, TrainConfig
from train.epoch.replay_epoch import ReplayConfig
from train.runs.arm_model import DistilledArm
from train.runs.evaluate import Evaluator
from train.runs.export import export_run
from train.runs.folder import Run
from train.runs.run import begin_with, task_of, train


@dataclasses.dataclass(frozen=True)
class RegressionConfig(ReplayConfig):
    """Settings of `Regression`."""

    def make_learner(self, env):
        return Regression(env.observation_size, env.action_size)


SETTINGS = RegressionConfig(
    n_arms=16,
    total_env_steps=512,
    updates_per_env_step=1.0,
    warmup_env_steps=32,
    batch_size=64,
    replay_capacity=512,
    vector_steps_per_epoch=4,
    hindsight=HindsightConfig(reached_share=1.0),
)
CONFIG = TrainConfig(learner=SETTINGS, evaluation_epochs=2, env=EnvConfig(engine="chain", n_poses=256))


pytestmark = pytest.mark.usefixtures("quick_compiler")


class Regression:
    """A network fitted to the actions that led to the poses reached, which hindsight makes the goals."""

    def __init__(self, obs_size, action_size):
        self.obs_size, self.network, self.optimizer = obs_size, Actor(action_size, (16,)), optax.adam(1e-2)

    def init(self, key):
        params = self.network.init(key, jnp.zeros(self.obs_size))
        return params, self.optimizer.init(params)

    def act(self, state, obs, key):
        action = self.mode(state[0], obs)
        return jnp.clip(action + 0.3 * jax.random.normal(key, action.shape), -1.0, 1.0)

    def policy(self, state):
        return state[0]

    def mode(self, policy, obs):
        return jnp.tanh(self.network.apply(policy, obs)[0])

    def parts(self, state):
        return {"policy": state[0]}

    def adopt(self, state, parts):
        raise ValueError(f"got a donor of {', '.join(parts)}, expected none for this learner")

    def update(self, state, batch, key):
        answer = batch.stored.sensed_action
        error = lambda params: jnp.mean((self.mode(params, batch.obs) - answer) ** 2)  # noqa: E731
        loss, grads = jax.value_and_grad(error)(state[0])
        updates, opt_state = self.optimizer.update(grads, state[1])
        return (optax.apply_updates(state[0], updates), opt_state), {"regression/loss": loss}


@pytest.fixture(scope="module")
def task():
    env = ReachEnv(SHORT, CONFIG.env)
    task = task_of(CONFIG, env)
    return task._replace(evaluate=Evaluator(env, task.job.learner, n_goals=64))


@pytest.fixture(scope="module", autouse=True)
def known():
    """The learner stands among those of `train.config`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(LEARNERS, "regression", RegressionConfig)
        yield


@pytest.fixture(scope="module")
def run(task, tmp_path_factory):
    run = Run.create(tmp_path_factory.mktemp("own") / "run", CONFIG, CalibratedArm(SHORT))
    train(run, task, Console(file=io.StringIO()))
    return run


def test_it_learns_in_the_epoch_and_is_evaluated(run):
    rows = run.metrics()
    figures = json.loads((run.path / "evaluation.json").read_text())
    assert rows[-1]["updates"] == 512 - 2 * 16  # those of the first two vector steps, before warm-up ended
    assert rows[-1]["regression/loss"] < 0.3 * rows[1]["regression/loss"]
    assert figures["median_mm"] < 0.6 * rows[1]["evaluation/median_mm"]  # 0.52


@pytest.fixture
def arm(make_arm_model):
    return DistilledArm(make_arm_model(SHORT), {})


def test_the_exported_policy_acts_as_it_does(run, task, tmp_path, arm):
    policy = load_policy(export_run(run, arm, tmp_path / "policy.npz"))
    shapes = task.job.shapes()
    params = task.job.learner.policy(run.checkpoints.restore(shapes).learner)
    obs = np.random.default_rng(0).normal(size=(8, 18)).astype(np.float32)
    (first, bias), (head, head_bias) = policy.layers
    expected = np.tanh(np.maximum(obs @ first + bias, 0.0) @ head + head_bias)
    np.testing.assert_allclose(task.job.learner.mode(params, obs), expected, atol=1e-5)


def test_a_checkpoint_of_another_learner_and_a_donor_are_refused(run, task):
    learner = TQCConfig(**{**dataclasses.asdict(SETTINGS), "hindsight": SETTINGS.hindsight})
    other = task_of(dataclasses.replace(CONFIG, learner=learner), task.job.env)
    with pytest.raises(InputError, match=f"{run.path}: got a checkpoint of other parts or sizes"):
        run.checkpoints.restore(other.job.shapes())
    with pytest.raises(InputError, match=f"{run.path}: got a policy without critics"):
        begin_with(other, 0, {"agent": run})
    with pytest.raises(InputError, match=f"{run.path}: got a donor of policy, expected none"):
        begin_with(task, 0, {"agent": run})
    with pytest.raises(InputError, match=f"{run.path}: reward: got none, expected a run of `imitate`"):
        begin_with(other, 0, {"reward": run})


def test_a_learner_from_demonstrations_needs_some(task):
    imitation = dataclasses.replace(CONFIG, learner=ImitationConfig(total_env_steps=4_096))
    with pytest.raises(InputError, match="learner: got 'imitation' without demonstrations, expected a file"):
        task_of(imitation, task.job.env)
