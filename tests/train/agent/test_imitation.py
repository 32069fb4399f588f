"""Learning from demonstrations: rows and rewards of a batch, parts of other runs, demonstrated goals."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from train.agent.hindsight import HindsightConfig, relabel
from train.agent.imitation import Imitation, goal_weights
from train.agent.learner import Experience, Transition
from train.epoch.job import Job

B = 16

pytestmark = pytest.mark.usefixtures("quick_compiler")


@pytest.fixture
def new(imitation_config, short_env, shown):
    """Changes of the config -> a learner."""

    def make(**changes):
        return Imitation(dataclasses.replace(imitation_config.learner, **changes), short_env, shown)

    return make


@pytest.fixture
def stored(short_env, shown):
    """Random actions from one demonstrated position towards another."""
    row = jnp.arange(B)
    pose, goal = (jnp.asarray(shown.positions)[(row + k) % len(shown.positions)] for k in (0, 1))
    action = jax.random.uniform(jax.random.key(0), (B, short_env.action_size), minval=-1.0)
    cost = row.astype(jnp.float32)
    return Experience(pose, goal, action, pose, action, row < 0, cost, jnp.ones(B))


def relabelled(learner, stored):
    """The batch that an epoch makes of stored transitions."""
    return relabel(stored, jax.random.PRNGKey(0), learner.config.hindsight, learner.env)


def test_the_experts_rows_are_right_answers_to_their_goals(new, short_env, stored):
    """The arm reaches a row's goal with the expert's action of that row."""
    learner = new()

    @jax.jit
    def answered(stored):
        batch = learner.with_expert(relabelled(learner, stored), (jnp.arange(B) + 1) % 6)
        arms = jax.vmap(short_env.reset)(jax.random.split(jax.random.PRNGKey(4), 4))
        return batch, jax.vmap(short_env.step)(arms, batch.action[:4])

    batch, after = answered(stored)
    assert learner.n_expert == 4
    np.testing.assert_allclose(after.pipeline_state.pose[:, :3], stored.goal[:4, :3], atol=0.01)
    expected = short_env.observe(after.pipeline_state.pose, stored.goal[:4])
    np.testing.assert_allclose(batch.next_obs[:4], expected, atol=1e-3)
    np.testing.assert_array_equal(batch.action[4:], stored.action[4:])
    assert np.all(batch.terminated[:4] == 1.0)


def test_rewards_are_learned_for_goals_asked_for_and_clearance_is_always_charged(new, short_env, stored):
    learner = new(learned_weight=2.0, hand_made_weight=0.5)
    discriminator = jax.jit(learner.init)(jax.random.PRNGKey(0)).discriminator
    given = -3.0 - stored.clearance_cost  # the environment's, costs included, of all rows but the expert's
    hindsight, expert = jnp.arange(B) >= 12, jnp.arange(B) < learner.n_expert
    start = short_env.observe(stored.pose, stored.goal)
    elsewhere = short_env.observe(stored.pose, stored.goal + jnp.array([1.0, 0, 0, 0, 0, 0]))
    obs = jnp.where(hindsight[:, None], elsewhere, start)
    batch = Transition(obs, stored.action, jnp.where(expert, 100.0, given), obs, jnp.zeros(B), stored)
    rewards, _ = learner.rewards(batch, hindsight, discriminator)
    learned = np.where(hindsight, 0.0, learner.gail.reward(discriminator.params, obs, stored.action))
    assert np.all(learned[:12] < 0.0)
    expected = np.where(expert, 0.5 * 100.0, 0.5 * -3.0 - stored.clearance_cost) + 2.0 * learned
    np.testing.assert_allclose(rewards, expected, rtol=1e-5)


@pytest.mark.parametrize("frozen", [False, True])
def test_an_update_moves_the_discriminator_unless_it_is_frozen(new, stored, frozen):
    learner = new(frozen=frozen)
    before = jax.jit(learner.init)(jax.random.PRNGKey(0))
    update = jax.jit(lambda state, key: learner.update(state, relabelled(learner, stored), key))
    after, metrics = update(before, jax.random.PRNGKey(1))
    heads = [state.discriminator.params["params"]["head"]["kernel"] for state in (before, after)]
    assert np.array_equal(*heads) == frozen and ("gail/accuracy" in metrics) != frozen
    assert float(metrics["gail/reward"]) < 0.0
    policies = [jax.tree.leaves(learner.policy(state)) for state in (before, after)]
    assert not np.array_equal(policies[0][-1], policies[1][-1])


def test_as_printed_the_expert_is_at_the_pose_shown_before_and_relabelled_goals_have_the_learned_reward(
    new, stored, short_env, shown
):
    learner, seen = new(expert_start="shown", expert_share=0.0, hindsight=HindsightConfig(1.0)), {}
    update = learner.gail.update
    learner.gail.update = lambda s, e, a, key: seen.update(expert=e, agent=a) or update(s, e, a, key)
    learner.tqc.update = lambda agent, batch, key: seen.update(batch=batch) or (agent, {})
    state = jax.jit(learner.init)(jax.random.PRNGKey(0))

    @jax.jit
    def run(state, stored, key):
        return learner.update(state, relabelled(learner, stored), key)[0], seen

    after, seen = run(state, stored, jax.random.PRNGKey(1))
    goal = (np.arange(B) + 1) % 6
    positions = jnp.asarray(shown.positions)
    shown_at = short_env.observe(positions[np.maximum(goal - 1, 0)], positions[goal])  # one sequence
    np.testing.assert_allclose(seen["expert"][0], shown_at, atol=1e-6)
    np.testing.assert_array_equal(seen["expert"][1], jnp.asarray(shown.actions)[goal])
    batch = seen["batch"]
    np.testing.assert_allclose(seen["agent"][0], short_env.observe(stored.pose, stored.next_pose), atol=1e-6)
    np.testing.assert_array_equal(seen["agent"][0], batch.obs)
    learned = learner.gail.reward(after.discriminator.params, batch.obs, batch.action)
    np.testing.assert_allclose(batch.reward, learned - stored.clearance_cost, rtol=1e-5)


def test_parts_of_other_runs_are_taken_if_they_fit(new):
    learner, reach = new(), new().tqc
    init = jax.jit(learner.init)
    state, donor = init(jax.random.PRNGKey(0)), init(jax.random.PRNGKey(1))
    same = lambda a, b: jax.tree.map(np.testing.assert_array_equal, a, b)  # noqa: E731
    shown = learner.parts(donor)
    same(shown["policy"], learner.policy(donor))
    reward = shown.pop("reward")
    for parts in (shown, reach.parts(reach.init(jax.random.PRNGKey(2)))):  # of `imitate` and of `reach`
        taken = learner.adopt(state, parts)
        same(reach.parts(taken.agent), parts)
        same(taken.discriminator, state.discriminator)
    taken = learner.adopt(state, {"reward": reward})
    same(taken.agent, state.agent)
    same(taken.discriminator.params, donor.discriminator.params)
    narrow = new(hidden=(8,))
    with pytest.raises(ValueError, match="networks: got layers of .* expected"):
        learner.adopt(state, narrow.parts(narrow.init(jax.random.PRNGKey(0))))
    without = new(learned_weight=0.0, hand_made_weight=1.0)
    assert "reward" not in without.parts(without.init(jax.random.PRNGKey(0)))


@pytest.fixture(scope="module")
def epoch(imitation_config, short_env, shown):
    return imitation_config.learner.make_epoch(short_env, shown)


@pytest.fixture(scope="module")
def job(epoch):
    return Job(epoch)


@pytest.fixture(scope="module")
def goals(epoch):
    return epoch.goals


@pytest.fixture(scope="module")
def run(job, goals):
    """State, first epoch, epoch after the last -> the state and the metrics after them."""

    def train(state, first, last):
        metrics = {}
        for k in range(first, last):
            state, metrics = job.epoch(goals.prepare(state, k, lambda: np.ones(6)))
        return state, metrics

    return train


def indices(goals, poses, off_mm=0.0):
    distance = np.linalg.norm(np.asarray(poses)[:, None] - np.asarray(goals.positions), axis=-1)
    assert np.all(distance.min(axis=1) <= off_mm)
    return distance.argmin(axis=1)


def test_an_episode_goes_from_one_demonstrated_position_to_another(job, goals):
    state = job.init(jax.random.PRNGKey(0))
    arm = state.arms.pipeline_state
    assert len(set(indices(goals, arm.pose))) > 1
    assert set(indices(goals, arm.goal)) <= {0, 2, 4}  # the first stage has every second position
    np.testing.assert_allclose(state.arms.obs, job.env.observe(arm.pose, arm.goal), atol=1e-6)


def test_stages_change_the_goals_and_thin_the_replay(job, goals, run):
    state, _ = run(job.init(jax.random.PRNGKey(0)), 0, 4)
    n = int(state.memory.size)
    assert n == 64 and set(indices(goals, state.memory.data.goal)) <= {0, 2, 4}
    later = goals.prepare(jax.tree.map(jnp.copy, state), 4, lambda: np.ones(6))
    assert int(later.memory.size) == n // 4 and np.all(later.goals == 1.0)
    state, metrics = run(state, 4, 8)
    assert {1, 3, 5} & set(indices(goals, state.memory.data.goal))
    assert job.n_traces == 1 and all(np.isfinite(value) for value in metrics.values())


def test_a_run_is_traced_once_and_continues_bit_for_bit_across_a_stage(job, run):
    whole, metrics = run(job.init(jax.random.PRNGKey(2)), 0, 6)
    part, _ = run(job.init(jax.random.PRNGKey(2)), 0, 4)
    part = jax.tree.map(jnp.asarray, jax.device_get(part))
    resumed, _ = run(part, 4, 6)
    assert job.n_traces == 1 and all(np.isfinite(value) for value in metrics.values())
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(whole), jax.device_get(resumed))


def test_goals_shift_to_the_positions_that_are_missed_by_most():
    weight = goal_weights(np.array([1.0, 9.0, 3.0, 0.0]), np.array([True, False, True, True]))
    np.testing.assert_allclose(weight, [1 / 6 + 1 / 8, 0.0, 1 / 6 + 3 / 8, 1 / 6])
    even = goal_weights(np.zeros(4), np.array([True, False, True, True]))
    np.testing.assert_allclose(even, [1 / 3, 0.0, 1 / 3, 1 / 3])


def test_rebalanced_goals_are_drawn_by_their_weights(job, goals):
    errors_mm = np.array([0.0, 0, 0, 0, 0, 10.0])
    state = goals.prepare(job.init(jax.random.PRNGKey(0)), 6, lambda: errors_mm)  # every third epoch
    arms = jax.jit(jax.vmap(lambda key: goals.begin(state.goals, state.arms, key)))
    drawn = arms(jax.random.split(jax.random.PRNGKey(5), 500)).pipeline_state.goal.reshape(-1, 6)
    share = np.mean(indices(goals, drawn) == 5)
    assert abs(share - (0.5 / 6 + 0.5)) < 4 * np.sqrt(0.25 / len(drawn))
