"""A learned reward beside the hand-made one, with everything else equal, in simulation.

The scripted expert shows picking and placing in the 300 mm pipe, on the simulated arm itself. All policies
learn from these positions with the same steps, networks, rows of the expert, temperature and hindsight; only
the reward differs. Rewards have different sizes, so each has a scale of its own, that of its preset. What
suits one reward may not suit the other: both are tried with the other settings of either preset. A
further kind has the gradient penalty on the discriminator's probability, as the paper prints it, in place
of its logit.

All kinds are judged alike: success at the shown positions is looked at every `LOOK` env steps, and that at
held-out positions, half-way between these, at the end.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from benchmarks.harness.common import target
from benchmarks.harness.parallel import Job, in_parallel
from benchmarks.paper.summary import SUCCESS
from mjx_softarm import ArmSpec
from mjx_softarm._support import cli
from mjx_softarm.env import ReachEnv
from mjx_softarm.mdp.actions import ActionMap
from mjx_softarm.mechanics.pipe import PIPES_MM
from train.agent.gail import Gail, gradient_penalty
from train.agent.hindsight_tqc import HindsightTQC
from train.agent.imitation import Imitation
from train.config import ImitationConfig, override
from train.demos.demonstrations import Demonstrations
from train.demos.expert import Expert, ExpertError, Posture
from train.demos.waypoints import Waypoint, task
from train.presets import IMITATION_PRESETS
from train.runs.positions import PositionEvaluator
from train.runs.task import task_of

TASK = "pipe300"
LOOK = 512  # env steps between two evaluations
PRESETS = ("pipe", "hand-made")  # whose settings are tried
LEARNED, HAND_MADE, PRINTED = "learned", "hand-made", "learned, penalty as printed"
KINDS = (  # reward, settings
    *((reward, settings) for settings in PRESETS for reward in (LEARNED, HAND_MADE)),
    (PRINTED, "pipe"),
)


class PrintedGail(Gail):
    """Discriminator with the gradient penalty as the paper prints it: on D, the probability of the agent."""

    def penalty(self, logits: Any, obs: Any, action: Any) -> Any:
        """Return the penalty; see `gradient_penalty`."""
        return gradient_penalty(lambda *at: jax.nn.sigmoid(-logits(*at)), obs, action)


def measure(
    seeds: cli.Integers = (0, 1, 2, 3, 4), steps: int | None = None, arms: int = 128
) -> dict[str, Any]:
    """Compare a learned reward with the hand-made one, everything else being equal.

    Args:
        seeds: of training
        steps: environment steps of training; None: the presets'
        arms: simulated side by side
    """
    spec = ArmSpec.default()
    shown, between = demonstrated(spec)
    jobs: list[Job] = [
        (
            ", ".join(kind),
            learn,
            (kind[0], config_of(*kind, steps, arms), spec, shown, (shown.positions, between), seeds),
        )
        for kind in KINDS
    ]
    rows = in_parallel(jobs)
    means, runs = [], []
    for kind, (name, *_) in zip(KINDS, jobs, strict=True):
        told = dict(zip(("reward", "settings"), kind, strict=True))
        means.append(told | summary(rows[name]))
        runs += [told | row for row in rows[name]]
    return {
        "positions": {"shown": len(shown.positions), "held out": len(between)},
        "targets": targets(runs),
        "means": means,
        "runs": runs,
    }


def config_of(reward: str, settings: str, steps: int | None, arms: int) -> ImitationConfig:
    """Return the config of a kind: the settings of one preset, and the reward of its own or of the other."""
    own, base = IMITATION_PRESETS[HAND_MADE if reward == HAND_MADE else "pipe"], IMITATION_PRESETS[settings]
    config = dataclasses.replace(
        base,
        learned_weight=own.learned_weight,
        hand_made_weight=own.hand_made_weight,
        expert_share=IMITATION_PRESETS["pipe"].expert_share,
        tqc=dataclasses.replace(base.tqc, reward_scale=own.tqc.reward_scale),
        vector_steps_per_epoch=max(1, LOOK // arms),
        n_arms=arms,
        total_env_steps=steps or base.total_env_steps,
    )
    return override(config, [f"env.pipe_diameter_mm={PIPES_MM[TASK]}"])


def demonstrated(spec: ArmSpec) -> tuple[Demonstrations, np.ndarray]:
    """Return what the expert shows, and held-out positions (k, 6) [mm, deg] that it can reach between."""
    waypoints, pipe = task(TASK, spec)
    expert = Expert(spec, pipe=pipe)
    found: Posture = expert.plan(waypoints)
    between = []
    for k, (one, next_one) in enumerate(itertools.pairwise(waypoints)):
        half = Waypoint(f"between {k}", 0.5 * (one.finger_m + next_one.finger_m))
        try:
            between.append(expert.reach(half.name, expert.target(half), found.pressure_kpa[k]).pose)
        except ExpertError:
            continue  # around a corner of the pipe
    return _demonstrations(found, spec), np.array(between, np.float32)


def _demonstrations(found: Posture, spec: ArmSpec) -> Demonstrations:
    actions = ActionMap.from_spec(spec).from_lengths(found.spring_m)
    sequence = np.zeros(len(actions), np.int32)
    return Demonstrations(found.pose.astype(np.float32), actions.astype(np.float32), sequence)


def learn(
    reward: str,
    config: ImitationConfig,
    spec: ArmSpec,
    shown: Demonstrations,
    judged: tuple[np.ndarray, np.ndarray],
    seeds: Sequence[int],
) -> list[dict[str, Any]]:
    """Return a row for each seed: env steps to success, success in the end, and the curve of success.

    Args:
        reward: `LEARNED`, `HAND_MADE` or `PRINTED`.
        config: of that kind.
        spec: the arm.
        shown: demonstrations to learn from.
        judged: the scripted expert's positions (m, 6) and the held-out ones (k, 6) [mm, deg].
        seeds: of training.
    """
    env = ReachEnv(spec, config.env)
    learner = Imitation(HindsightTQC(config, env), config, env, shown)
    if reward == PRINTED:
        learner.gail = PrintedGail(env.observation_size, env.action_size, config.gail)
    todo = task_of(config, env, shown, learner=learner)
    at_shown, held_out = (
        PositionEvaluator(env, learner, positions, np.ones(len(positions), bool)) for positions in judged
    )
    rows = []
    for seed in seeds:
        state, curve = todo.job.start(lambda seed=seed: todo.job.init(jax.random.PRNGKey(seed))), []
        for epoch in range(config.n_epochs):
            state, _ = todo.job.epoch(todo.prepare(state, epoch))
            curve.append((int(state.n_env_steps), at_shown(todo.job.policy(state))[0].success_share))
        policy = todo.job.policy(state)
        (end, _), (between_them, _) = at_shown(policy), held_out(policy)
        first = next((n for n, share in curve if share >= SUCCESS), None)
        rows.append(
            {
                "seed": seed,
                "steps_to_success": first,
                "success": end.success_share,
                "median_mm": end.median_mm,
                "held_out_success": between_them.success_share,
                "held_out_median_mm": between_them.median_mm,
                "curve": curve,
            }
        )
    return rows


def targets(runs: Sequence[dict[str, Any]]) -> list[dict[str, str]]:
    """Return the target of each settings: fewer env steps with the learned reward."""
    found = []
    for settings in dict.fromkeys(run["settings"] for run in runs):
        steps: dict[str, list[float]] = {LEARNED: [], HAND_MADE: [], PRINTED: []}
        for run in runs:
            if run["settings"] == settings:
                steps[run["reward"]].append(run["steps_to_success"] or np.inf)
        learned, hand_made = np.median(steps[LEARNED]), np.median(steps[HAND_MADE])
        text = f"{settings}: {100 * SUCCESS:g} % success in fewer env steps with the learned reward"
        told = [f"{n:,.0f}" if np.isfinite(n) else "never" for n in (learned, hand_made)]
        measured = "{} learned, {} hand-made, medians".format(*told)
        found.append(target(text, measured, bool(learned < hand_made)))
    return found


def summary(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the least, middle and most steps to success of a kind's runs, and the means of the rest."""
    steps = sorted(run["steps_to_success"] or np.inf for run in runs)
    told = ["never" if n == np.inf else f"{n:,}" for n in (steps[0], steps[len(steps) // 2], steps[-1])]
    names = "success", "median_mm", "held_out_success", "held_out_median_mm"
    return {f"steps to {100 * SUCCESS:g} %: least, median, most": ", ".join(told)} | {
        name: float(np.mean([run[name] for run in runs])) for name in names
    }
