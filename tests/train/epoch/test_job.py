"""The training epoch: traced once, bad arms kept out, bit for bit the same after a restore."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.spec import ArmSpec
from train.agent.hindsight_tqc import HindsightTQC
from train.agent.tqc import TQCConfig
from train.config import TrainConfig
from train.epoch.job import Job
from train.runs.checkpoint import Run, RunError

CONFIG = TrainConfig(
    n_arms=8,
    total_env_steps=128,
    updates_per_env_step=0.5,
    warmup_env_steps=16,
    batch_size=16,
    replay_capacity=64,
    vector_steps_per_epoch=2,
    env=EnvConfig(n_poses=256),
    tqc=TQCConfig(hidden_actor=(16, 16), hidden_critic=(16, 16), learning_rate_end=0.1),
)


def new_job(config, env):
    return Job(config, env, HindsightTQC(config, env))


# A short arm compiles in seconds, with MJX too.
SHORT = {"n_sections": 1, "links_per_section": 2}


@pytest.mark.parametrize("change", [{"engine": "mjx"}, {"mode": "dynamic", "dynamic_step_s": 0.04}], ids=str)
def test_the_other_engines_train_by_changing_a_word(change):
    config = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, **change))
    job = new_job(config, ReachEnv(ArmSpec.default().replace(structure=SHORT), config.env))
    state = job.init(jax.random.PRNGKey(0))
    for _ in range(3):
        state, metrics = job.epoch(state)
    assert job.n_traces == 1 and int(state.n_updates) == 4 * (3 * 2 - 2)
    assert int(state.memory.size) == 3 * 2 * 8 - int(state.n_unsettled) > 40
    assert all(np.isfinite(value) for value in metrics.values())


@pytest.fixture(scope="module")
def job():
    return new_job(CONFIG, ReachEnv(config=CONFIG.env))


def start(job):
    return job.init(jax.random.PRNGKey(0))


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(a), jax.device_get(b))


def test_a_run_traces_its_epoch_once_and_counts_what_it_did(job):
    state = start(job)
    for _ in range(4):
        state, metrics = job.epoch(state)
    assert job.n_traces == 1
    assert int(state.n_env_steps) == 4 * 2 * 8
    # Warm-up lasts until 16 steps are stored: the update after the second vector step is the first.
    assert int(state.n_updates) == 4 * (4 * 2 - 2)
    assert int(state.memory.size) == 64 and int(state.n_unsettled) == 0
    assert all(np.isfinite(value) for value in metrics.values())


def test_a_start_compiles_the_epoch_once_beside_what_comes_first(job):
    other = new_job(CONFIG, job.env)
    state = other.start(lambda: start(other))
    assert other.n_traces == 1  # before it is called
    assert_equal(state, start(job))
    expected = start(job)
    for _ in range(2):
        (state, _), (expected, _) = other.epoch(state), job.epoch(expected)
    assert_equal(state, expected)
    assert other.n_traces == 1


def test_what_fails_beside_the_compilation_is_raised(job):
    def fail():
        raise RunError("no such run")

    with pytest.raises(RunError, match="no such run"):
        new_job(CONFIG, job.env).start(fail)


def test_warm_up_explores_uniformly_and_does_not_learn(job):
    state, metrics = job.epoch(start(job))
    assert int(state.n_updates) == 0 and metrics["tqc/critic_loss"] == 0.0
    action = np.asarray(state.memory.data.action)[:16]
    assert np.abs(action).max() > 0.9 and abs(action.mean()) < 0.15


def test_an_arm_that_does_not_settle_is_reset_counted_and_never_stored(job):
    state = start(job)
    arm = state.arms.pipeline_state
    poisoned = arm.chamber_stiffness.at[jnp.array([1, 5])].set(jnp.nan)
    arms = state.arms.replace(pipeline_state=arm._replace(chamber_stiffness=poisoned))
    state, metrics = job.epoch(state._replace(arms=arms))
    assert int(state.n_unsettled) == 2 and metrics["env/unsettled"] == 2
    assert int(state.memory.size) == 2 * 8 - 2
    jax.tree.map(
        lambda x: np.testing.assert_array_equal(np.isfinite(x), True), jax.device_get(state.memory.data)
    )
    assert np.isfinite(state.arms.pipeline_state.chamber_stiffness).all()


def test_a_restored_run_continues_bit_for_bit(job, tmp_path):
    state = start(job)
    for _ in range(3):
        state, _ = job.epoch(state)
    run = Run.create(tmp_path, CONFIG, job.env.spec)
    run.save(3, state)
    direct, _ = job.epoch(state)

    again = Run.open(tmp_path)
    assert again.config == CONFIG and again.spec == job.env.spec and again.latest_epoch == 3
    epoch, restored = again.restore(jax.eval_shape(job.init, jax.random.PRNGKey(7)))
    assert epoch == 3
    resumed, _ = job.epoch(restored)
    assert_equal(direct, resumed)


def test_a_run_without_checkpoint_says_so(job, tmp_path):
    run = Run.create(tmp_path / "new", dataclasses.replace(CONFIG, seed=5), job.env.spec)
    with pytest.raises(RunError, match="holds no checkpoint"):
        run.restore(jax.eval_shape(job.init, jax.random.PRNGKey(0)))


def test_a_checkpoint_of_another_structure_is_refused_in_words(job, tmp_path):
    run = Run.create(tmp_path, CONFIG, job.env.spec)
    run.save(0, state := start(job))
    for other in ({**state._asdict(), "more": state.key}, state._replace(key=state.arms.obs)):
        with pytest.raises(RunError, match=f"{tmp_path}: its checkpoint has other parts or sizes"):
            run.restore(other)
