"""Several runs of one structure as one vmapped job: seeds, and settings that are plain numbers.

The members of a sweep share all that has a shape or decides what is computed. The settings in which they
differ are traced: one compilation serves all members and all values. `Job` is built anew inside the traced
function, from a config that holds traced numbers, and knows nothing of sweeps.

The members have one count of epochs. A branch on a count of each member would compute both of its
sides, and warm-up would cost as much as learning.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm._support import xla
from mjx_softarm.env import Randomisation, ReachEnv
from mjx_softarm.env.state import EpisodeMotion
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.mechanics.workspace import Pool
from mjx_softarm.spec import ArmSpec
from train.agent.registry import World, learner_of
from train.config import ConfigError, TrainConfig
from train.epoch.job import Job, kind_of
from train.epoch.poses import Poses
from train.epoch.state import TrainState

# Groups of settings of the environment that are plain numbers, and single ones.
_ENV_GROUPS = {"env.reward": RewardConfig, "env.randomisation": Randomisation}
_ENV_NUMBERS = ("env.saturation_tolerance_mm", "env.clearance_cost_per_mm", "env.clearance_margin_mm")


def variable(config: TrainConfig) -> tuple[str, ...]:
    """Return the names of the settings in which members may differ: numbers that enter the computation.

    The other settings decide what is computed, and on what shapes.
    """
    names = {"learner": config.learner.VARIABLE}
    for group, kind in _ENV_GROUPS.items():
        numbers = (field for field in dataclasses.fields(kind) if not isinstance(field.default, tuple))
        names[group] = tuple(field.name for field in numbers)
    return (*(f"{group}.{name}" for group, own in names.items() for name in own), *_ENV_NUMBERS)


_AXES = TrainState(**{**dict.fromkeys(TrainState._fields, cast(Any, 0)), "n_epochs": cast(Any, None)})


def setting(config: Any, path: str) -> Any:
    """Return the value of a setting such as `learner.gamma`."""
    for name in path.split("."):
        config = getattr(config, name)
    return config


def with_env_config(env: ReachEnv, config: Any) -> ReachEnv:
    """Return the environment with a config that differs in `variable` settings alone."""
    other = copy.copy(env)
    other.config = config
    other.episode_motion = env.episode_motion.spread_by(config.randomisation)
    return other


def check_delays(spec: ArmSpec, configs: Sequence[TrainConfig]) -> None:
    """Refuse members in motion whose longest dead times differ in whole control periods.

    The commands that wait are part of the state, whose shapes the members share.

    Raises:
        ConfigError: they differ.
    """
    each = {EpisodeMotion(spec, config.env).n_earlier: config.env.randomisation for config in configs}
    if len(each) > 1:
        spreads = (
            f"delay_max_s {x.delay_max_s:g}, regulator_spread {x.regulator_spread:g}" for x in each.values()
        )
        got = " and ".join(spreads)
        period_s = 1.0 / spec.control.rate_hz
        expected = f"dead times that end in the same control period of {period_s:g} s"
        raise ConfigError(f"env.randomisation: got {got}, expected {expected}: train them one by one")


class SweepJob:
    """Fixed parts of the members, and functions that change the states of all of them.

    A state of a sweep is a `TrainState` whose arrays have an axis of n members in front, all but
    `n_epochs`. `n_traces` counts how often the epoch was traced: once in a sweep.
    """

    def __init__(self, configs: Sequence[TrainConfig], varied: Sequence[str], env: ReachEnv):
        """Prepare the functions; nothing is compiled yet.

        Args:
            configs: configs of the members, which differ in their seeds and in the settings `varied` alone.
            varied: names of settings.
            env: environment of the first member.
        """
        self.config, self.env, self.n = configs[0], env, len(configs)
        self.learner = learner_of(self.config.learner, World(env))
        self.keys = jnp.stack([jax.random.PRNGKey(config.seed) for config in configs])
        self.numbers = {
            path: jnp.asarray([setting(config, path) for config in configs], jnp.float32) for path in varied
        }
        self.n_traces = 0
        self._pool_of = Poses(env, configs[0]).at  # all members share the poses of the first
        init = jax.vmap(self._init, in_axes=(0, 0, None), out_axes=_AXES)
        epoch = jax.vmap(self._epoch, in_axes=(_AXES, 0, None), out_axes=(_AXES, 0))
        self._init_all = xla.jit(init, "once")
        self._epoch_all = xla.jit(epoch, kind_of(env, self.learner), donate_argnums=0)
        self._take = jax.jit(lambda tree, k: jax.tree.map(lambda x: x[k], tree))
        self._stack = jax.jit(lambda *trees: jax.tree.map(lambda *x: jnp.stack(x), *trees))

    def init(self) -> TrainState:
        """Return the initial state of all members."""
        return self._init_all(self.keys, self.numbers, self._pool_of(0))

    def epoch(self, states: TrainState) -> tuple[TrainState, dict[str, Array]]:
        """Run an epoch of all members, with metrics (n,)."""
        return self._epoch_all(states, self.numbers, self._pool_of(int(states.n_epochs)))

    def member(self, states: TrainState, k: int) -> TrainState:
        """Return the state of one member, as an ordinary run has it."""
        own = self._take(states._replace(n_epochs=None), k)
        return own._replace(n_epochs=states.n_epochs)

    def member_shapes(self) -> TrainState:
        """Return the shapes of a member's state."""
        states = jax.eval_shape(self._init_all, self.keys, self.numbers, self.env.poses.shapes)
        return jax.eval_shape(self.member, states, 0)

    def together(self, members: Sequence[TrainState]) -> TrainState:
        """Return the state of all members from the states of each."""
        states = self._stack(*(own._replace(n_epochs=None) for own in members))
        return states._replace(n_epochs=members[0].n_epochs)

    def _init(self, key: Array, numbers: Mapping[str, Array], pool: Pool) -> TrainState:
        with self.env.poses.given(pool):
            return self._job(numbers).first(key)

    def _epoch(
        self, state: TrainState, numbers: Mapping[str, Array], pool: Pool
    ) -> tuple[TrainState, dict[str, Array]]:
        self.n_traces += 1
        with self.env.poses.given(pool):
            return self._job(numbers).advance(state)

    def _job(self, numbers: Mapping[str, Array]) -> Job:
        config = self.config
        for path, number in numbers.items():
            config = _with_number(config, path, number)
        env = with_env_config(self.env, config.env)
        return Job(config.learner, env, learner_of(config.learner, World(env)))


def _with_number(config: Any, path: str, number: Array) -> Any:
    """Return a copy of a config with a traced number; its checks need values, and have passed before."""
    name, _, rest = path.partition(".")
    changed = copy.copy(config)
    value = _with_number(getattr(config, name), rest, number) if rest else number
    object.__setattr__(changed, name, value)  # the class is frozen
    return changed
