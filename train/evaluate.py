"""How well a policy reaches: held-out goals over the whole workspace, and the paper's circle."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm import rewards, xla
from mjx_softarm._mjx import State
from mjx_softarm.env import EnvConfig, Randomisation, ReachEnv
from mjx_softarm.workspace import HELD_OUT_SEED, circle_poses
from train.tqc import TQC

N_GOALS = 2_000
N_ACTIONS = 4


class Reached(NamedTuple):
    """What an arm reached at each of n goals, after its last action."""

    goal: Array  # (n, 6) [mm, deg]
    pose: Array  # (n, 6) [mm, deg]
    scaled_error: Array  # (n,) norm of e
    saturated_chambers: Array  # (n,)
    settled: Array  # (n,) bool, after every action
    pressure_kpa: Array  # (n, n_chambers)

    @property
    def tip_error_mm(self) -> Array:
        return np.linalg.norm(np.asarray(self.pose - self.goal)[:, :3], axis=-1)


@dataclass(frozen=True)
class Summary:
    """The figures that stand in tables."""

    median_mm: float
    p95_mm: float
    reached_share: float  # norm of e below theta, and no chamber saturated
    saturated_share: float  # goals at which a chamber is saturated
    unsettled: int
    circle_mean_mm: float
    circle_max_mm: float
    circle_saturated_chambers: int  # summed over the circle's points

    def to_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


class Evaluator:
    """Evaluates actors of one structure on one arm without randomisation; compiled once.

    Every goal gets `N_ACTIONS` actions of the deterministic policy, and what stands after the last counts. On
    the workspace each arm starts at a random pose; on the circle, a single arm goes from point to point,
    once around to get there.
    """

    def __init__(self, env: ReachEnv, agent: TQC, n_goals: int = N_GOALS):
        nominal: EnvConfig = dataclasses.replace(env.config, randomisation=Randomisation())
        self.env = env if nominal == env.config else ReachEnv(env.spec, nominal, env.s2r)
        self.agent = agent
        self.goals = self.env.sample_pool(n_goals, HELD_OUT_SEED).pose
        self.circle = jnp.asarray(circle_poses())
        self._workspace = xla.jit(self._reach_all, env.uses_mjx)
        self._circle = xla.jit(self._follow, env.uses_mjx)

    def __call__(self, actor_params: Any) -> tuple[Summary, Reached, Reached]:
        """Figures, and what was reached on the workspace and on the circle, as NumPy arrays."""
        workspace = jax.device_get(self._workspace(actor_params, self.goals))
        circle = jax.device_get(self._circle(actor_params, self.circle))
        return summarise(workspace, circle, self.env.config.reward.threshold), workspace, circle

    def _act(self, actor_params: Any, state: State, goal: Array) -> tuple[State, Reached]:
        """N_ACTIONS towards one goal."""
        arm = state.pipeline_state._replace(goal=goal)
        state = state.replace(pipeline_state=arm, obs=self.env.observe(arm.pose, goal))

        def act(state: State, _):
            after = self.env.step(state, self.agent.act_mode(actor_params, state.obs))
            return after, after.info["valid"]

        state, settled = jax.lax.scan(act, state, None, length=N_ACTIONS)
        arm, config = state.pipeline_state, self.env.config.reward
        return state, Reached(
            goal=goal,
            pose=arm.pose,
            scaled_error=jnp.linalg.norm(rewards.scaled_error(arm.pose, goal, config)),
            saturated_chambers=state.metrics["saturated_chambers"],
            settled=jnp.all(settled),
            pressure_kpa=arm.pressure_kpa,
        )

    def _reach_all(self, actor_params: Any, goals: Array) -> Reached:
        keys = jax.random.split(jax.random.PRNGKey(HELD_OUT_SEED), len(goals))
        starts = jax.vmap(self.env.reset)(keys)
        return jax.vmap(lambda state, goal: self._act(actor_params, state, goal)[1])(starts, goals)

    def _follow(self, actor_params: Any, path: Array) -> Reached:
        start = self.env.reset(jax.random.PRNGKey(HELD_OUT_SEED))
        twice = jnp.concatenate([path, path])
        _, reached = jax.lax.scan(lambda state, goal: self._act(actor_params, state, goal), start, twice)
        return jax.tree.map(lambda x: x[len(path) :], reached)


def summarise(workspace: Reached, circle: Reached, threshold: float) -> Summary:
    """Figures of what was reached."""
    error, around = workspace.tip_error_mm, circle.tip_error_mm
    free = workspace.saturated_chambers == 0
    return Summary(
        median_mm=float(np.median(error)),
        p95_mm=float(np.quantile(error, 0.95)),
        reached_share=float(np.mean((workspace.scaled_error < threshold) & free & workspace.settled)),
        saturated_share=float(np.mean(~free)),
        unsettled=int(np.sum(~workspace.settled) + np.sum(~circle.settled)),
        circle_mean_mm=float(np.mean(around)),
        circle_max_mm=float(np.max(around)),
        circle_saturated_chambers=int(np.sum(circle.saturated_chambers)),
    )
