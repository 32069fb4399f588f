"""Evaluation of a policy: at held-out goals and on the paper's circle, or at demonstrated positions.

There are two sets of held-out goals. The first has random pressures and is rarely near the rim; the second is
uniform in volume, rim included.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm._support import xla
from mjx_softarm.env import Randomisation, ReachEnv
from mjx_softarm.env.state import State
from mjx_softarm.mdp import rewards
from mjx_softarm.mdp.actions import N_ACTIONS
from mjx_softarm.mechanics.excitation import circle_poses
from mjx_softarm.mechanics.workspace import HELD_OUT_SEED
from mjx_softarm.sensing.pose import pose_error

N_GOALS = 2_000
NEAR_MM = 5.0  # tip error of an arm that has arrived, in motion
UNCORRECTED = np.zeros(6)  # limit of a shift of goals
PATH = 80  # goals that one arm visits in turn; two laps of the circle are one path, too


class Reached(NamedTuple):
    """Results of an arm at each of n goals, after its last action."""

    goal: Array  # (n, 6) [mm, deg]
    pose: Array  # (n, 6) [mm, deg]
    scaled_error: Array  # (n,) norm of e
    saturated_chambers: Array  # (n,)
    settled: Array  # (n,) bool, whether the arm settled after every action
    pressure_kpa: Array  # (n, n_chambers)
    clearance_mm: Array  # (n,) body to the wall, in motion the least on the way; infinite without a pipe
    near_s: Array  # (n,) time until the tip is within NEAR_MM for good; infinite if never, NaN at rest

    @property
    def tip_error_mm(self) -> np.ndarray:
        """Distances (..., n) of the tips to their goals."""
        return np.linalg.norm(np.asarray(self.pose - self.goal)[..., :3], axis=-1)


def figure(label: str, unit: str, decimals: int = 0, **default: Any) -> Any:
    """Return a field of `Figures`, which a table shows with label and unit; a share is shown in %."""
    return dataclasses.field(metadata={"row": (label, unit, decimals)}, **default)


@dataclass(frozen=True)
class Figures:
    """Figures of an evaluation, as tables show them."""

    def to_dict(self) -> dict[str, Any]:
        """Return the figures that are not None."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value is not None}

    def rows(self) -> list[tuple[str, str]]:
        """Return the rows of a table: label, and value with its unit."""
        rows = []
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            if value is not None and "row" in item.metadata:
                label, unit, decimals = item.metadata["row"]
                rows.append((label, f"{value * (100 if unit == '%' else 1):.{decimals}f} {unit}".rstrip()))
        return rows


@dataclass(frozen=True)
class Summary(Figures):
    """Figures at the held-out goals and on the circle."""

    median_mm: float = figure("tip error, median", "mm", 2)
    p95_mm: float = figure("tip error, 95 %", "mm", 2)
    # A goal is reached with the norm of e below theta and no chamber saturated.
    reached_share: float = figure("goals reached", "%", 1)
    saturated_share: float = figure("goals with a saturated chamber", "%", 1)
    even_median_mm: float = figure("uniform in volume: median", "mm", 2)
    even_p95_mm: float = figure("uniform in volume: 95 %", "mm", 2)
    even_reached_share: float = figure("uniform in volume: reached", "%", 1)
    unsettled: int = figure("arms that did not settle", "")  # at all goals and on the circle
    circle_mean_mm: float = figure("circle, mean tip error", "mm", 2)
    circle_max_mm: float = figure("circle, largest tip error", "mm", 2)
    circle_saturated_chambers: int = figure("circle, saturated chambers", "")  # summed over the points
    # In motion only. The time `near_s` is infinite for an arm that is never within NEAR_MM for good.
    near_share: float | None = figure(f"within {NEAR_MM:g} mm for good", "%", 1, default=None)
    near_median_s: float | None = figure("  after, in the median of all", "s", 2, default=None)


@dataclass(eq=False)
class _Evaluator:
    """Evaluate policies of one learner on one arm without randomisation; compiled once."""

    env: ReachEnv
    learner: Any
    n_actions: int = N_ACTIONS  # actions of the deterministic policy towards each goal; the last state counts
    shift_limit: np.ndarray = field(default_factory=lambda: UNCORRECTED)  # (6,) [mm, deg], see `reach`

    def __post_init__(self) -> None:
        self.env = nominal(self.env)

    def _from_start(self, policy: Any, path: Array, key: Array) -> Reached:
        """Return the results of one arm, from a random start, along a path (n, 6) of goals."""
        start = self.env.reset(key)
        return follow(self.env, self.learner, policy, path, start, self.n_actions, self.shift_limit)


@dataclass(eq=False)
class Evaluator(_Evaluator):
    """Evaluate policies over the workspace and on the circle.

    Each of many arms goes from goal to goal of its part of the workspace. One goes twice around the circle,
    and its second lap counts.
    """

    n_goals: int = N_GOALS

    def __post_init__(self) -> None:
        super().__post_init__()
        self.circle = np.asarray(circle_poses(self.env.spec))
        self._follow = xla.jit(jax.vmap(self._from_start, in_axes=(None, 0, 0)))

    @property
    def title(self) -> str:
        """Title of the table of figures."""
        return f"{self.n_goals} held-out goals"

    def headline(self, row: dict[str, float]) -> str:
        """Return a short text for a row of metrics with an evaluation."""
        return f"held-out median {row['evaluation/median_mm']:.1f} mm"

    @functools.cached_property
    def goals(self) -> np.ndarray:
        """Both sets of held-out poses (2 n_goals, 6) [mm, deg], drawn on first use."""
        sets = (self.env.sample_pool(self.n_goals, HELD_OUT_SEED, evenly) for evenly in (False, True))
        return np.concatenate([poses.pose for poses in sets])

    def __call__(self, policy: Any) -> tuple[Summary, Reached, Reached]:
        """Return figures, and the results on the first set and on the circle as NumPy arrays."""
        # Follow all paths; the policy may be on many devices, and one is enough.
        policy = jax.device_get(policy)
        lap, n_goals = len(self.circle), len(self.goals)
        paths = np.concatenate([paths_of(self.goals), np.tile(self.circle, (2, 1))[None]])
        results = jax.device_get(self._follow(policy, paths, start_keys(len(paths))))
        # Split the results into the sets of goals and the circle.
        both = jax.tree.map(lambda x: np.split(x[:-1].reshape(-1, *x.shape[2:])[:n_goals], 2), results)
        workspace, even = (Reached(*(field[k] for field in both)) for k in range(2))
        circle = jax.tree.map(lambda x: x[-1, lap:], results)
        return summarise(workspace, even, circle, self.env.config.reward.threshold), workspace, circle


def paths_of(goals: Array | np.ndarray) -> np.ndarray:
    """Return goals (n, 6) as paths (n_arms, PATH, 6), in their order; the last one goes on with the first."""
    return np.resize(goals, (-(-len(goals) // PATH), PATH, 6))


def start_keys(n_arms: int) -> Array:
    """Return keys of the arms' random starts."""
    return jax.random.split(jax.random.PRNGKey(HELD_OUT_SEED), n_arms)


def nominal(env: ReachEnv) -> ReachEnv:
    """Return the environment without randomisation; it draws from the same pool of poses.

    At rest it is the closed form. MJX puts the tip within a micrometre of it, and takes ten seconds more to
    compile.
    """
    other = copy.copy(env)
    engine = env.config.engine if env.config.in_motion else "chain"
    config = dataclasses.replace(env.config, engine=engine)
    other.config = dataclasses.replace(config, randomisation=Randomisation(payload_max_kg=0.0))
    return other


def towards(env: ReachEnv, state: State, goal: Array) -> State:
    """Return an arm's state with another goal (6,) [mm, deg]."""
    arm = state.pipeline_state._replace(goal=goal)
    return state.replace(pipeline_state=arm, obs=env.observe(arm.pose, goal, arm.sensed))


def reach(
    env: ReachEnv,
    learner: Any,
    policy: Any,
    state: State,
    goal: Array,
    n_actions: int = N_ACTIONS,
    shift_limit: np.ndarray = UNCORRECTED,
) -> tuple[State, Reached]:
    """Take n actions with one arm towards a goal (6,); return its state and the result.

    Each action leaves an error, which is subtracted from the goal of the next, by `shift_limit` at most.
    """

    def act(before: tuple[State, Array], _):
        state, shift = before
        after = env.step(state, learner.mode(policy, state.obs))
        left = rewards.asked_error(after.pipeline_state.pose, goal, env.config.reward)
        shift = jnp.clip(shift - left, -shift_limit, shift_limit)
        seen = {name: after.info.get(name, ()) for name in ("valid", "clearance_mm", "path_mm")}
        return (towards(env, after, goal + shift), shift), seen

    # Act, and derive the figures of the whole way.
    begin = towards(env, state, goal), jnp.zeros(6)
    (state, _), way = jax.lax.scan(act, begin, None, length=n_actions)
    arm = state.pipeline_state
    near_s = jnp.asarray(jnp.nan)
    if env.config.in_motion:
        way_mm = jnp.concatenate([way["path_mm"].reshape(-1, 3), arm.pose[None, :3]])
        near_s = time_near(way_mm, goal[:3], 1.0 / env.spec.control.rate_hz)
    return state, Reached(
        goal=goal,
        pose=arm.pose,
        scaled_error=jnp.linalg.norm(rewards.scaled_error(arm.pose, goal, env.config.reward)),
        saturated_chambers=state.metrics["saturated_chambers"],
        settled=jnp.all(way["valid"]),
        pressure_kpa=arm.pressure_kpa,
        clearance_mm=jnp.min(way["clearance_mm"]) if env.config.in_motion else state.info["clearance_mm"],
        near_s=near_s,
    )


def time_near(way_mm: Array, goal_mm: Array, period_s: float) -> Array:
    """Return when a tip came near its goal (3,) for good, () [s].

    Its positions `way_mm` (t, 3) are a control period apart, the first where it began.
    """
    far = jnp.linalg.norm(way_mm - goal_mm, axis=-1) > NEAR_MM
    last_far = jnp.max(jnp.where(far, jnp.arange(1, len(way_mm) + 1), 0))
    return jnp.where(far[-1], jnp.inf, period_s * last_far)


def follow(
    env: ReachEnv,
    learner: Any,
    policy: Any,
    path: Array,
    state: State,
    n_actions: int = N_ACTIONS,
    shift_limit: np.ndarray = UNCORRECTED,
) -> Reached:
    """Return the results of one arm, from a state, along a path (n, 6) of goals."""

    def go_on(state: State, goal: Array) -> tuple[State, Reached]:
        return reach(env, learner, policy, state, goal, n_actions, shift_limit)

    return jax.lax.scan(go_on, state, path)[1]


def summarise(workspace: Reached, even: Reached, circle: Reached, threshold: float) -> Summary:
    """Return the figures of results on both sets of goals and on the circle."""
    error, around, at_even = workspace.tip_error_mm, circle.tip_error_mm, even.tip_error_mm

    def reached_share(at: Reached) -> float:
        free = at.saturated_chambers == 0
        return float(np.mean((at.scaled_error < threshold) & free & at.settled))

    # Figures of motion, where the arms moved.
    motion = {}
    if not np.isnan(workspace.near_s).any():
        median_s = float(np.quantile(workspace.near_s, 0.5, method="higher"))  # some are infinite
        motion = {
            "near_share": float(np.mean(np.isfinite(workspace.near_s))),
            "near_median_s": median_s if np.isfinite(median_s) else None,
        }
    return Summary(
        median_mm=float(np.median(error)),
        p95_mm=float(np.quantile(error, 0.95)),
        reached_share=reached_share(workspace),
        saturated_share=float(np.mean(workspace.saturated_chambers > 0)),
        even_median_mm=float(np.median(at_even)),
        even_p95_mm=float(np.quantile(at_even, 0.95)),
        even_reached_share=reached_share(even),
        unsettled=sum(int(np.sum(~at.settled)) for at in (workspace, even, circle)),
        circle_mean_mm=float(np.mean(around)),
        circle_max_mm=float(np.max(around)),
        circle_saturated_chambers=int(np.sum(circle.saturated_chambers)),
        **motion,
    )


@dataclass(frozen=True)
class PositionSummary(Figures):
    """Figures at demonstrated positions."""

    error_mm: tuple[float, ...]  # tip error at each position
    success: tuple[bool, ...]  # of each: close enough, no chamber saturated, the body inside the pipe
    success_share: float = figure("positions with success", "%", 1)
    success_first_share: float = figure("positions of the first stage with success", "%", 1)
    reached_share: float = figure("positions reached", "%", 1)  # with or without saturation and contact
    median_mm: float = figure("tip error, median", "mm", 2)
    max_mm: float = figure("tip error, largest", "mm", 2)
    x_mm: float = figure("mean absolute error in x", "mm", 2)
    y_mm: float = figure("mean absolute error in y", "mm", 2)
    z_mm: float = figure("mean absolute error in z", "mm", 2)
    saturated_positions: int = figure("positions with a saturated chamber", "")
    outside_positions: int = figure("positions with the body outside the pipe", "")
    unsettled: int = figure("arms that did not settle", "")


@dataclass(eq=False)
class PositionEvaluator(_Evaluator):
    """Evaluate policies on demonstrated positions, one after another.

    An action leads to the same pose from every start, so one arm goes from position to position. Its second
    pass counts.
    """

    positions: np.ndarray = field(kw_only=True)  # (m, 6) [mm, deg], float32
    first: np.ndarray = field(kw_only=True)  # (m,) bool: goals of the first stage

    def __post_init__(self) -> None:
        super().__post_init__()
        self._go = xla.jit(self._from_start)

    @property
    def title(self) -> str:
        """Title of the table of figures."""
        return f"{len(self.positions)} demonstrated positions"

    def headline(self, row: dict[str, float]) -> str:
        """Return a short text for a row of metrics with an evaluation."""
        share, median_mm = row["evaluation/success_share"], row["evaluation/median_mm"]
        return f"success at {100 * share:.0f} % of the positions, median {median_mm:.1f} mm"

    def __call__(self, policy: Any) -> tuple[PositionSummary, Reached]:
        """Return figures, and results as NumPy arrays."""
        policy, m = jax.device_get(policy), len(self.positions)  # it may be on many devices
        passes = jax.device_get(self._go(policy, np.tile(self.positions, (2, 1)), start_keys(1)[0]))
        second = jax.tree.map(lambda x: x[m:], passes)
        return summarise_positions(second, self.env.config.reward.threshold, self.first), second


def summarise_positions(reached: Reached, threshold: float, first: np.ndarray) -> PositionSummary:
    """Return the figures of results at m positions; `first` (m,) bool marks the goals of the first stage."""
    close = reached.scaled_error < threshold  # (m,)
    saturated, outside = reached.saturated_chambers > 0, reached.clearance_mm <= 0.0
    success = close & ~saturated & ~outside & reached.settled
    error_mm = reached.tip_error_mm
    x, y, z = np.abs(pose_error(reached.pose, reached.goal))[..., :3].mean(axis=0)
    return PositionSummary(
        success_share=float(success.mean()),
        success_first_share=float(success[first].mean()),
        reached_share=float(close.mean()),
        median_mm=float(np.median(error_mm)),
        max_mm=float(error_mm.max()),
        x_mm=float(x),
        y_mm=float(y),
        z_mm=float(z),
        saturated_positions=int(np.count_nonzero(saturated)),
        outside_positions=int(np.count_nonzero(outside)),
        unsettled=int(np.count_nonzero(~reached.settled)),
        error_mm=tuple(float(value) for value in error_mm),
        success=tuple(bool(value) for value in success),
    )
