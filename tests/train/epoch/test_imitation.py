"""Learning from demonstrations: goals, stages, balance, and a run that continues bit for bit."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.spec import ArmSpec
from train.agent.gail import GailConfig
from train.agent.hindsight import HindsightConfig
from train.agent.hindsight_tqc import HindsightTQC
from train.agent.imitation import Imitation
from train.agent.learner import Experience
from train.agent.tqc import TQCConfig, Transition
from train.config import ConfigError, ImitationConfig, Stage, from_dict, override, to_dict
from train.demos.demonstrations import Demonstrations
from train.epoch.devices import mesh_of
from train.epoch.goals import DemonstratedGoals, goal_weights
from train.epoch.job import Job
from train.runs.evaluate import Reached
from train.runs.positions import PositionEvaluator, summarise

N = 6  # positions
SPEC = ArmSpec.default().replace(structure={"n_sections": 1, "links_per_section": 2})
CONFIG = ImitationConfig(
    n_arms=8,
    total_env_steps=128,
    updates_per_env_step=0.5,
    warmup_env_steps=16,
    batch_size=16,
    replay_capacity=64,
    vector_steps_per_epoch=2,
    env=EnvConfig(n_poses=256),
    tqc=TQCConfig(hidden_actor=(16, 16), hidden_critic=(16, 16), learning_rate_end=0.1),
    hindsight=HindsightConfig(0.0, 0.0),
    gail=GailConfig(hidden=(16,)),
    stages=(Stage(share=0.5, every=2), Stage(share=0.5, kept=0.25)),
    rebalance_env_steps=48,
)


@pytest.fixture(scope="module")
def env():
    return ReachEnv(SPEC, CONFIG.env)


@pytest.fixture(scope="module")
def demonstrations(env):
    positions, actions = env.pool.pose[:N], env.action_of(env.pool.spring_m[:N])
    return Demonstrations(positions, actions, np.zeros(N, np.int32))


def new_job(config, env, demonstrations, mesh=None):
    learner = Imitation(HindsightTQC(config, env), config, env, demonstrations)
    return Job(config, env, learner, DemonstratedGoals(config, env, demonstrations.positions), mesh)


@pytest.fixture(scope="module")
def job(env, demonstrations):
    return new_job(CONFIG, env, demonstrations)


def run(job, state, first, last):
    told = []
    for epoch in range(first, last):
        state, metrics = job.epoch(job.goals.begin_stage(job, state, epoch))
        told.append(metrics)
    return state, told


def copy(state):
    return jax.tree.map(jnp.copy, state)


def indices(job, poses):
    distance = np.linalg.norm(np.asarray(poses)[:, None] - np.asarray(job.goals.positions), axis=-1)
    assert np.all(distance.min(axis=1) == 0.0)
    return distance.argmin(axis=1)


def test_an_episode_goes_from_one_demonstrated_position_to_another(job):
    state = job.init(jax.random.PRNGKey(0))
    arm = state.arms.pipeline_state
    assert len(set(indices(job, arm.pose))) > 1
    assert set(indices(job, arm.goal)) <= {0, 2, 4}  # the first stage has every second position
    np.testing.assert_allclose(state.arms.obs, job.env.observe(arm.pose, arm.goal), atol=1e-6)


def test_stages_change_the_goals_and_thin_the_replay(job):
    state, _ = run(job, job.init(jax.random.PRNGKey(0)), 0, 4)
    n = int(state.memory.size)
    assert n == 64 and set(indices(job, state.memory.data.goal)) <= {0, 2, 4}
    later = job.goals.begin_stage(job, copy(state), 4)
    assert int(later.memory.size) == n // 4 and np.all(later.goals == 1.0)
    state, _ = run(job, state, 4, 8)
    assert {1, 3, 5} & set(indices(job, state.memory.data.goal))


def test_a_run_traces_its_epoch_once_and_learns_in_it(job):
    state = job.init(jax.random.PRNGKey(1))
    before = jax.device_get(state.learner.discriminator.params)
    state, told = run(job, state, 0, 8)
    assert job.n_traces == 1
    after = jax.device_get(state.learner.discriminator.params)
    assert not np.array_equal(before["params"]["head"]["kernel"], after["params"]["head"]["kernel"])
    assert all(np.isfinite(value) for value in told[-1].values())
    assert float(told[-1]["gail/reward"]) < 0.0


def test_a_run_continues_bit_for_bit_across_a_stage(job):
    whole, _ = run(job, job.init(jax.random.PRNGKey(2)), 0, 6)
    part, _ = run(job, job.init(jax.random.PRNGKey(2)), 0, 4)
    part = jax.tree.map(jnp.asarray, jax.device_get(part))
    resumed, _ = run(job, part, 4, 6)
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(whole), jax.device_get(resumed))


def test_many_devices_learn_as_one_does_across_a_stage_and_a_balance(env, demonstrations, job):
    spread = new_job(CONFIG, env, demonstrations, mesh_of("8"))
    figures = []
    for each in (job, spread):
        state = each.init(jax.random.PRNGKey(5))
        for epoch in range(6):
            state = each.goals.begin_stage(each, state, epoch)
            if epoch == 5:
                state = each.goals.rebalance(state, epoch, np.arange(float(N)))
            state, metrics = each.epoch(each.place(state))
        figures.append((jax.device_get(metrics), jax.device_get(each.policy(state))))
    assert spread.n_traces == 1
    for one, many in zip(*map(jax.tree.leaves, figures), strict=True):
        np.testing.assert_allclose(many, one, rtol=1e-3, atol=1e-4)


def test_the_experts_rows_are_right_answers_to_their_goals(job):
    """What the arm reaches with an expert's action, from the start of that row, is the row's goal."""
    state, _ = run(job, job.init(jax.random.PRNGKey(3)), 0, 2)
    stored = jax.tree.map(lambda x: x[:16], state.memory.data)
    index = indices(job, stored.goal)
    own = job.learner.learner.transitions(stored, jax.random.PRNGKey(0))
    batch = job.learner.with_expert(own, stored, index)
    assert job.learner.n_expert == 4
    arms = jax.vmap(job.env.reset)(jax.random.split(jax.random.PRNGKey(4), 4))
    after = jax.vmap(job.env.step)(arms, batch.action[:4])
    np.testing.assert_allclose(after.pipeline_state.pose[:, :3], stored.goal[:4, :3], atol=0.01)
    expected = job.env.observe(after.pipeline_state.pose, stored.goal[:4])
    np.testing.assert_allclose(batch.next_obs[:4], expected, atol=1e-3)
    np.testing.assert_array_equal(batch.action[4:], stored.action[4:])
    assert np.all(batch.terminated[:4] == 1.0)


def test_rewards_are_learned_for_goals_asked_for_and_clearance_is_always_charged(env, demonstrations):
    config = dataclasses.replace(CONFIG, learned_weight=2.0, hand_made_weight=0.5)
    learner = new_job(config, env, demonstrations).learner
    discriminator = learner.init(jax.random.PRNGKey(0)).discriminator
    n = 8
    pose, goal = learner.positions[jnp.arange(n) % N], learner.positions[(jnp.arange(n) + 1) % N]
    cost = jnp.arange(float(n))
    given = -3.0 - cost  # the environment's reward, what clearance costs included, of all but the expert's
    start = env.observe(pose, goal)
    hindsight = jnp.array([False] * 6 + [True] * 2)
    obs = jnp.where(hindsight[:, None], env.observe(pose, goal + jnp.array([1.0, 0, 0, 0, 0, 0])), start)
    action, zero = jnp.zeros((n, env.action_size)), jnp.zeros(n)
    first = jnp.arange(n) < learner.n_expert
    batch = Transition(obs, action, jnp.where(first, 100.0, given), obs, zero)
    stored = Experience(pose, goal, action, pose, action, zero > 0, cost, zero)
    rewards, _ = learner.rewards(batch, stored, start, discriminator)
    learned = np.where(hindsight, 0.0, learner.gail.reward(discriminator.params, obs, action))
    assert learner.n_expert == 4 and np.all(learned[:6] < 0.0)
    expected = np.where(first, 0.5 * 100.0, 0.5 * -3.0 - cost) + 2.0 * learned
    np.testing.assert_allclose(rewards, expected, rtol=1e-5)


def test_frozen_reward_stays_and_sees_no_experts_actions(env, demonstrations):
    frozen = new_job(dataclasses.replace(CONFIG, frozen=True), env, demonstrations)
    state = frozen.init(jax.random.PRNGKey(0))
    before = jax.device_get(state.learner.discriminator)
    state, _ = run(frozen, state, 0, 3)
    jax.tree.map(np.testing.assert_array_equal, before, jax.device_get(state.learner.discriminator))
    assert frozen.learner.n_expert == 0 and int(state.n_updates) > 0


def test_goals_shift_to_the_positions_that_are_missed_by_most():
    weight = goal_weights(np.array([1.0, 9.0, 3.0, 0.0]), np.array([True, False, True, True]))
    np.testing.assert_allclose(weight, [1 / 6 + 1 / 8, 0.0, 1 / 6 + 3 / 8, 1 / 6])
    even = goal_weights(np.zeros(4), np.array([True, False, True, True]))
    np.testing.assert_allclose(even, [1 / 3, 0.0, 1 / 3, 1 / 3])


def test_rebalanced_goals_are_drawn_by_their_weights(job):
    state = job.goals.rebalance(job.init(jax.random.PRNGKey(0)), 4, np.array([0.0, 0, 0, 0, 0, 10.0]))
    arms = jax.vmap(lambda key: job.goals.begin(state.goals, state.arms, key))
    goals = arms(jax.random.split(jax.random.PRNGKey(5), 500)).pipeline_state.goal.reshape(-1, 6)
    share = np.mean(indices(job, goals) == 5)
    assert abs(share - (0.5 / 6 + 0.5)) < 4 * np.sqrt(0.25 / len(goals))


def test_positions_are_evaluated_with_body_and_pressures(env, job, demonstrations):
    class Perfect:
        """An agent whose actor knows every answer."""

        def mode(self, policy, obs):
            goal = obs[6:12] * job.env.scale.scale + job.env.scale.centre
            nearest = jnp.argmin(jnp.sum((job.learner.positions - goal) ** 2, axis=-1))
            return job.learner.actions[nearest]

    first = job.goals.of_stage(0)
    figures, at = PositionEvaluator(env, Perfect(), demonstrations.positions, first)({})
    assert figures.success_share == figures.reached_share == 1.0 and figures.max_mm < 0.05
    assert len(figures.error_mm) == N and np.isinf(at.reached.clearance_mm).all()
    narrow = ReachEnv(SPEC, dataclasses.replace(CONFIG.env, pipe_diameter_mm=130.0))  # narrower than the arm
    figures, at = PositionEvaluator(narrow, Perfect(), demonstrations.positions, first)({})
    assert figures.reached_share == 1.0 and figures.success_share == 0.0 and figures.outside_positions == N
    assert (at.reached.clearance_mm < 0.0).all()


def test_success_at_the_first_stages_positions_is_told_apart():
    zero = np.zeros(3)
    reached = Reached(
        np.zeros((3, 6)), np.zeros((3, 6)), zero, zero, zero == 0, zero, np.array([5.0, -1, -1])
    )
    figures, _ = summarise(reached, 0.03, np.array([True, True, False]))
    assert (figures.success_share, figures.success_first_share) == (pytest.approx(1 / 3), 0.5)
    assert figures.outside_positions == 2


def test_each_stages_end_is_evaluated():
    config = dataclasses.replace(CONFIG, total_env_steps=160, evaluation_epochs=4)  # 10 epochs, 5 first
    assert [epoch for epoch in range(1, 11) if config.evaluates_after(epoch)] == [4, 5, 8, 10]


def test_config_survives_json():
    assert from_dict(to_dict(CONFIG)) == CONFIG
    piped = dataclasses.replace(CONFIG, env=dataclasses.replace(CONFIG.env, pipe_diameter_mm=300.0))
    assert from_dict(to_dict(piped)) == piped


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("stages=[{}]", "settings"),
        ('stages=[{"share": 0.5, "every": 1, "kept": 1.0}]', "add up to 0.5, expected 1"),
        ('stages=[{"share": 1.0, "every": 0, "kept": 1.0}]', "every: got 0"),
        ("expert_share=1.0", "expert_share: got 1.0"),
        ("learned_weight=0", "expected some reward"),
        ("learned_weight=-1", "expected numbers >= 0"),
        ("rebalance_env_steps=-1", "rebalance_env_steps: got -1"),
        ("env.mode=dynamic", "expected 'quasistatic'"),
    ],
)
def test_a_bad_setting_is_told(assignment, message):
    with pytest.raises(ConfigError, match=message):
        override(CONFIG, [assignment])
