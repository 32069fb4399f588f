"""Gymnasium environments: many arms as one vector environment, or a single arm.

    envs = gymnasium.make_vec("mjx_softarm.env.gym:SoftArmReach-v0", num_envs=64)
    env = gymnasium.make("mjx_softarm.env.gym:SoftArmReach-v0", config=EnvConfig(observation="payload"))

Both are the `ReachEnv` of `mjx_softarm.env`, compiled, with NumPy arrays going in and out. An info holds

    pose (6,), goal (6,) [mm, deg]    after a reset and after a step
    is_success, valid (bool)          after a step, with the environment's metrics by name

An arm that did not settle ends its episode as truncated, with its last observation, reward 0 and `valid`
false: leave such a step out of a replay buffer.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from jax import Array

from mjx_softarm._support import xla
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.env.state import State
from mjx_softarm.env.vector import VectorEnv
from mjx_softarm.mdp.observation import OBS_SIZE
from mjx_softarm.spec import ArmSpec

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

ENV_ID = "SoftArmReach-v0"
EPISODE_LENGTH = 4  # actions; each leads to a rest, so a policy that knows the arm needs one

Info = dict[str, Any]


class SoftArmVectorEnv(gymnasium.vector.VectorEnv):
    """Arms that reach for poses, stepped together; an episode that ends is followed by a new one at once.

    `arm` is the paper's by default, and `max_episode_steps` the actions after which an episode is truncated.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int = EPISODE_LENGTH,
        arm: ArmSpec | None = None,
        config: EnvConfig | None = None,
    ):
        self.num_envs = num_envs
        self.env = _reach_env(arm or ArmSpec.default(), config or EnvConfig())
        self.single_observation_space, self.single_action_space = spaces(self.env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._arms = VectorEnv(self.env, num_envs, max_episode_steps)
        self._state: State | None = None
        self._reset_arms = xla.jit(self._arms.reset)
        self._step_arms = xla.jit(self._traced_step, donate_argnums=0)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[np.ndarray, Info]:
        """Start an episode with every arm; a seed fixes all that follows. There are no options."""
        super().reset(seed=seed)
        _refuse_options(options)
        self._state = state = self._reset_arms(_new_key(self.np_random))
        everywhere = np.ones(self.num_envs, bool)
        return _to_numpy(state.obs), _where(everywhere, _to_numpy(_reset_info(state)))

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """Act once with every arm, actions (num_envs, n_springs) in [-1, 1].

        Where an episode ends, observation and info belong to the next episode; `final_obs` and `final_info`
        are the last ones of the episode that ended.
        """
        # Act
        if self._state is None:
            raise gymnasium.error.ResetNeeded("SoftArmVectorEnv.step: got no episode, expected reset first")
        actions = _as_actions(actions, self.action_space.shape)
        self._state, results = self._step_arms(self._state, actions, _new_key(self.np_random))
        obs, reward, terminated, truncated, started, last, final_obs = _to_numpy(results)

        # Infos: of the next episode for arms whose episode is over, with the last ones of this episode beside
        over = terminated | truncated
        infos = _where(np.ones(self.num_envs, bool), started)
        infos |= _where(~over, {name: last[name] for name in last.keys() - started.keys()})
        if over.any():
            infos["final_obs"] = np.full(self.num_envs, None, object)
            for index in np.flatnonzero(over):
                infos["final_obs"][index] = final_obs[index]
            infos |= {"final_info": _where(over, last), "_final_obs": over.copy(), "_final_info": over.copy()}
        return obs, reward, terminated, truncated, infos

    def _traced_step(self, state: State, actions: Array, key: Array) -> tuple[State, tuple]:
        following, after, terminated, truncated = self._arms.step(state, actions, key)
        ends = terminated, truncated | ~after.info["valid"]
        infos = _reset_info(following), _step_info(after)
        return following, (following.obs, after.reward, *ends, *infos, after.obs)


class SoftArmEnv(gymnasium.Env):
    """One arm, by default the paper's, that reaches for poses; `gymnasium.make` adds a time limit."""

    def __init__(self, arm: ArmSpec | None = None, config: EnvConfig | None = None):
        self.env, self._reset_arm, self._step_arm = _compiled(arm or ArmSpec.default(), config or EnvConfig())
        self.observation_space, self.action_space = spaces(self.env)
        self._state: State | None = None

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[np.ndarray, Info]:
        """Start an episode; a seed fixes all that follows. There are no options."""
        super().reset(seed=seed)
        _refuse_options(options)
        self._state = state = self._reset_arm(_new_key(self.np_random))
        return _to_numpy(state.obs), _to_numpy(_reset_info(state))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Act once, action (n_springs,) in [-1, 1]."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("SoftArmEnv.step: got no episode, expected reset first")
        self._state = state = self._step_arm(self._state, _as_actions(action, self.action_space.shape))
        obs, reward, done, info = _to_numpy((state.obs, state.reward, state.done, _step_info(state)))
        info = {name: value if value.ndim else value.item() for name, value in info.items()}
        return obs, reward.item(), bool(done > 0) and info["valid"], not info["valid"], info


def as_sb3(envs: SoftArmVectorEnv) -> VecEnv:
    """Return the arms as a Stable-Baselines3 `VecEnv`, for its algorithms and its vector wrappers.

    Stable-Baselines3 takes vector environments of its own class only. An arm's info is empty but where its
    episode ends. Wrap the result in SB3's `VecMonitor` to log returns.
    """
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

    class SB3VecEnv(VecEnv):
        def __init__(self):
            super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

        def reset(self) -> np.ndarray:
            obs, _ = envs.reset(seed=self._seeds[0])
            self._reset_seeds()
            return obs

        def step_async(self, actions: np.ndarray) -> None:
            self._actions = actions

        def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Info]]:
            obs, reward, terminated, truncated, infos = envs.step(self._actions)
            over = terminated | truncated
            per_arm: list[Info] = [{} for _ in range(envs.num_envs)]
            for index in np.flatnonzero(over):
                final = infos["final_info"]
                per_arm[index] = {name: final[name][index] for name in final if not name.startswith("_")}
                per_arm[index]["terminal_observation"] = infos["final_obs"][index]
                per_arm[index]["TimeLimit.truncated"] = bool(truncated[index])
            return obs, reward, over, per_arm

        def close(self) -> None:
            envs.close()

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [getattr(envs, attr_name)] * len(list(self._get_indices(indices)))

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            raise NotImplementedError(f"{attr_name}: the arms are one compiled program, set it on a new one")

        def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
            raise NotImplementedError(f"{method_name}: the arms are one program, without methods each")

        def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
            return [False] * len(list(self._get_indices(indices)))

    return SB3VecEnv()


def spaces(env: ReachEnv) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Return the spaces of observations and actions; no section stretches to twice its length at rest."""
    rest_mm = 1e3 * env.spec.length_m
    limit = 1.01 * np.array([2 * rest_mm] * 3 + [180.0] * 3)
    centre = np.append(env.scale.centre[:3], np.zeros(3))
    # Positions differ by up to twice as much; angles wrap
    error = np.array(env.config.reward.weights) * np.array([2.0] * 3 + [1.0] * 3) * limit
    low, high = (-limit - centre) / env.scale.scale, (limit - centre) / env.scale.scale
    more = np.full(env.observation_size - OBS_SIZE, np.inf)  # payload, or speeds: no bounds are known
    least = np.concatenate([low, low, -error, -more]).astype(np.float32)
    greatest = np.concatenate([high, high, error, more]).astype(np.float32)
    actions = gymnasium.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)
    return gymnasium.spaces.Box(least, greatest), actions


_reach_env = functools.lru_cache(maxsize=8)(ReachEnv)  # its poses are settled once for equal arms


@functools.lru_cache(maxsize=8)
def _compiled(arm: ArmSpec, config: EnvConfig) -> tuple[ReachEnv, Callable, Callable]:
    """Return an environment, its reset and its step, compiled once for all that share arm and config."""
    env = _reach_env(arm, config)
    return env, xla.jit(env.reset), xla.jit(env.step)


def _reset_info(state: State) -> dict[str, Array]:
    return {"pose": state.pipeline_state.pose, "goal": state.pipeline_state.goal}


def _step_info(state: State) -> dict[str, Array]:
    outcome = {"is_success": state.metrics["reached"] > 0, "valid": state.info["valid"]}
    return _reset_info(state) | outcome | state.metrics


def _where(mask: np.ndarray, info: dict[str, np.ndarray]) -> Info:
    """Return Gymnasium's vector info: values where the mask is set, zeros elsewhere, and the masks."""
    if not mask.any():
        return {}
    shaped = {name: mask.reshape((-1,) + (1,) * (value.ndim - 1)) for name, value in info.items()}
    values = {name: np.where(shaped[name], value, np.zeros_like(value)) for name, value in info.items()}
    return values | {f"_{name}": mask.copy() for name in info}


def _to_numpy(tree: Any) -> Any:
    """Copy arrays to NumPy, where the caller may write to them."""
    return jax.tree.map(np.array, jax.device_get(tree))


def _new_key(rng: np.random.Generator) -> Array:
    bits = rng.integers(2**32, size=2, dtype=np.uint32)
    return jax.random.wrap_key_data(jnp.asarray(bits), impl="threefry2x32")


def _as_actions(actions: Any, shape: tuple[int, ...] | None) -> np.ndarray:
    actions = np.asarray(actions, np.float32)
    if actions.shape != shape:
        raise ValueError(f"actions: got shape {actions.shape}, expected {shape}")
    return actions


def _refuse_options(options: Info | None) -> None:
    if options:
        raise ValueError(f"reset: got options {', '.join(options)}, expected none")


gymnasium.register(
    ENV_ID,
    entry_point="mjx_softarm.env.gym:SoftArmEnv",
    vector_entry_point="mjx_softarm.env.gym:SoftArmVectorEnv",
    max_episode_steps=EPISODE_LENGTH,
)
