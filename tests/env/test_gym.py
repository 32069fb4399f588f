"""The Gymnasium environments against Gymnasium's own checks, its own vector environment, and SB3."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from mjx_softarm.env import EnvConfig
from mjx_softarm.env.gym import ENV_ID, EPISODE_LENGTH, SoftArmEnv, SoftArmVectorEnv, as_sb3

CONFIG = EnvConfig(engine="chain", n_poses=64)
N_ARMS, LIMIT = 6, 3


@pytest.fixture(scope="module")
def envs():
    return SoftArmVectorEnv(N_ARMS, max_episode_steps=LIMIT, config=CONFIG)


@pytest.fixture(scope="module")
def arm():
    """One arm with the specification that `gymnasium.make` gives it."""
    return gymnasium.make(ENV_ID, config=CONFIG).unwrapped


def to_goals(env, goals):
    """Actions that lead to goals (n, 6), which are poses of the pool."""
    pool = np.asarray(env.pool.pose)
    rows = [int(np.flatnonzero((pool == goal).all(axis=1))[0]) for goal in goals]
    return np.asarray(env.action_of(env.pool.spring_m[np.array(rows)]))


def still(envs):
    """Actions that neither saturate nor reach, from any start."""
    return np.array(envs.env.action_of(np.full((N_ARMS, 9), 0.17, np.float32)))


@pytest.mark.filterwarnings("error::UserWarning")
def test_gymnasium_s_checker_has_nothing_to_say(arm):
    check_env(arm)


@pytest.mark.parametrize("make, shape", [(SoftArmEnv, r"\(9,\)"), (SoftArmVectorEnv, r"\(1, 9\)")])
def test_a_step_before_a_reset_actions_of_another_shape_and_options_are_refused(make, shape):
    env = make(config=CONFIG)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(env.action_space.sample())
    env.reset()
    with pytest.raises(ValueError, match=rf"got shape \(8,\), expected {shape}"):
        env.step(np.zeros(8))
    with pytest.raises(ValueError, match="got options speed, expected none"):
        env.reset(options={"speed": 1})


def test_vector_env_and_gymnasium_s_vector_of_single_arms_return_the_same_structure(envs):
    def single():
        return gymnasium.wrappers.TimeLimit(SoftArmEnv(config=CONFIG), LIMIT)

    reference = SyncVectorEnv([single] * N_ARMS, autoreset_mode=AutoresetMode.SAME_STEP)
    assert reference.metadata == envs.metadata
    assert reference.observation_space == envs.observation_space
    assert reference.action_space == envs.action_space
    assert envs.single_action_space == gymnasium.spaces.Box(-1.0, 1.0, (9,), np.float32)

    def structure(value):
        """Names, shapes and kinds of an info's entries, and its masks, which begin with an underscore."""
        if isinstance(value, dict):
            masks = {name: mask.tolist() for name, mask in value.items() if name.startswith("_")}
            return {name: structure(item) for name, item in value.items()} | masks
        if value.dtype == object:
            return [None if item is None else structure(item) for item in value]
        return value.shape, value.dtype.kind

    both = [env.reset(seed=0) for env in (envs, reference)]
    assert [structure(infos) for _, infos in both] == [structure(both[1][1])] * 2
    for index in range(2 * LIMIT):
        actions = still(envs)
        if index == 1:
            actions[2] = np.nan  # so that one arm ends its episode alone
        both = [env.step(actions) for env in (envs, reference)]
        for ours, theirs in zip(both[0][1:4], both[1][1:4], strict=True):
            assert ours.shape == theirs.shape and ours.dtype.kind == theirs.dtype.kind
        np.testing.assert_array_equal(both[0][3], both[1][3])  # truncated
        assert structure(both[0][4]) == structure(both[1][4])


def test_time_runs_out_with_the_last_observation_in_final_obs_and_a_new_goal_in_obs(envs):
    first, infos = envs.reset(seed=5)
    goals = infos["goal"]
    np.testing.assert_allclose(first[:, 6:9] * 200.0 + [0, 0, -600], goals[:, :3], atol=1e-3)
    for index in range(LIMIT):
        obs, reward, terminated, truncated, infos = envs.step(still(envs))
        np.testing.assert_array_equal(truncated, index == LIMIT - 1)
        assert not terminated.any()
    final = np.stack(infos["final_obs"])
    np.testing.assert_array_equal(final[:, 6:12], first[:, 6:12])
    np.testing.assert_array_equal(infos["final_info"]["goal"], goals)
    assert not np.any(np.all(obs[:, 6:12] == first[:, 6:12], axis=1))
    assert not np.any(np.all(infos["goal"] == goals, axis=1))
    np.testing.assert_allclose(obs[:, :3] * 200.0 + [0, 0, -600], infos["pose"][:, :3], atol=1e-3)
    error = np.linalg.norm(final[:, 12:], axis=1)
    np.testing.assert_allclose(reward, -10 * error - 0.1 * LIMIT, rtol=1e-5)


def test_an_arm_at_its_goal_terminates_and_the_others_go_on(envs):
    _, infos = envs.reset(seed=6)
    actions = still(envs)
    actions[[1, 4]] = to_goals(envs.env, infos["goal"][[1, 4]])
    _, reward, terminated, truncated, infos = envs.step(actions)
    np.testing.assert_array_equal(terminated, np.isin(np.arange(N_ARMS), [1, 4]))
    np.testing.assert_array_equal(reward == 100.0, terminated)
    np.testing.assert_array_equal(infos["final_info"]["is_success"], terminated)
    assert not truncated.any()
    np.testing.assert_array_equal(infos["_final_obs"], terminated)
    np.testing.assert_array_equal(infos["_tip_error_mm"], ~terminated)


def test_make_vec_gives_the_vector_environment_with_the_registered_time_limit():
    envs = gymnasium.make_vec(ENV_ID, num_envs=2, config=CONFIG)
    assert type(envs) is SoftArmVectorEnv and envs.num_envs == 2
    assert envs._arms.episode_length == EPISODE_LENGTH


@pytest.fixture
def sb3():
    return pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")


@pytest.mark.filterwarnings("error::UserWarning")
def test_sb3_s_checker_has_nothing_to_say(sb3, arm):
    from stable_baselines3.common.env_checker import check_env as check_env_of_sb3

    check_env_of_sb3(arm, skip_render_check=True)


def test_sb3_learns_from_the_arms(sb3, envs):
    from stable_baselines3.common.vec_env import VecMonitor

    arms = VecMonitor(as_sb3(envs))
    few = {"learning_starts": 12, "batch_size": 8, "buffer_size": 1000}
    model = sb3.SAC("MlpPolicy", arms, seed=0, policy_kwargs={"net_arch": [8]}, **few)
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(60)
    changed = [not bool((p == q).all()) for p, q in zip(model.policy.parameters(), before, strict=True)]
    assert any(changed) and all(bool(p.isfinite().all()) for p in model.policy.parameters())
    buffer = model.replay_buffer
    n = buffer.pos
    assert n == 60 // N_ARMS
    # The successor is the same episode's: it has the same goal, also where the next one has another.
    np.testing.assert_array_equal(buffer.observations[:n, :, 6:12], buffer.next_observations[:n, :, 6:12])
    ended = buffer.dones[:n].astype(bool)
    np.testing.assert_array_equal(ended, buffer.timeouts[:n].astype(bool))
    assert len(model.ep_info_buffer) == ended.sum() >= N_ARMS
