"""Tasks of a run: to reach the whole workspace, or to reach positions as an expert showed.

A task composes a job of arms, goals and learner, and says how it is evaluated, shown, and prepared for an
epoch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, cast

from jax.sharding import Mesh

from mjx_softarm._support.lazy import LazyModule
from mjx_softarm.env import ReachEnv
from train.agent.imitation import ImitationConfig
from train.agent.learner import Learner
from train.agent.registry import LEARNERS, World, learner_of, name_of
from train.config import ConfigError, TrainConfig
from train.demos.demonstrations import Demonstrations
from train.epoch.goals import DemonstratedGoals
from train.epoch.job import Job
from train.epoch.poses import Poses
from train.epoch.state import TrainState
from train.runs.evaluate import N_GOALS, Evaluator
from train.runs.positions import PositionEvaluator

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from train.runs import plots
else:
    plots = LazyModule("train.runs.plots")


class Task(NamedTuple):
    """Job of a run, and how the run is evaluated, shown, and prepared for an epoch."""

    job: Job
    title: str  # of the table of figures
    evaluate: Evaluator | PositionEvaluator
    pictures: Callable[..., dict[str, Figure]]  # rows of metrics, results -> figures by name
    headline: Callable[[dict[str, float]], str]  # row of metrics with an evaluation -> a short text
    prepare: Callable[[TrainState, int], TrainState]  # state, epoch that follows -> state


def task_of(
    config: TrainConfig,
    env: ReachEnv,
    demonstrations: Demonstrations | None = None,
    mesh: Mesh | None = None,
) -> Task:
    """Return the task of a run.

    Args:
        config: settings of the run.
        env: environment of its arms.
        demonstrations: demonstrations to learn from, for a learner from demonstrations.
        mesh: devices to train on; None is one device.

    Raises:
        ConfigError: the learner needs demonstrations and has none, or the run cannot be split evenly over the
            devices of the mesh.
    """
    name, world = name_of(config.learner), World(env, mesh, demonstrations)
    if LEARNERS[name].from_demonstrations:
        if demonstrations is None:
            raise ConfigError(f"learner: got {name!r} without demonstrations, expected a file of them")
        own = cast(ImitationConfig, config.learner)
        return _imitation(own, env, demonstrations, mesh, learner_of(own, world))
    # Goals over the whole workspace, held-out ones for the evaluation.
    poses = Poses(env, config)
    job = Job(config.learner, env, learner_of(config.learner, world), mesh=mesh, pool_of=poses.at)
    return Task(
        job=job,
        title=f"{N_GOALS} held-out goals",
        evaluate=Evaluator(env, job.learner),
        pictures=lambda *found: plots.reach_pictures(*found),
        headline=lambda row: f"held-out median {row['evaluation/median_mm']:.1f} mm",
        prepare=lambda state, epoch: state,
    )


def _imitation(
    config: ImitationConfig,
    env: ReachEnv,
    demonstrations: Demonstrations,
    mesh: Mesh | None,
    learner: Learner,
) -> Task:
    # Arms whose goals are demonstrated positions, and the evaluation at these.
    goals = DemonstratedGoals(config, env, demonstrations)
    job = Job(config, env, learner, goals, mesh)
    evaluate = PositionEvaluator(env, learner, demonstrations, goals.of_stage(0))

    # Before an epoch: begin a stage of goals, or shift the goals to the positions with the largest errors.
    def prepare(state: TrainState, epoch: int) -> TrainState:
        every = config.rebalance_epochs
        if every and epoch and epoch % every == 0 and epoch not in config.stage_epochs:
            summary, _ = evaluate(job.policy(state))
            state = goals.rebalance(state, epoch, summary.error_mm)
        else:
            state = goals.begin_stage(job, state, epoch)
        return job.place(state)

    return Task(
        job=job,
        title=f"{len(demonstrations.positions)} demonstrated positions",
        evaluate=evaluate,
        pictures=lambda *found: plots.imitation_pictures(*found),
        headline=lambda row: (
            f"success at {100 * row['evaluation/success_share']:.0f} % of the positions, "
            f"median {row['evaluation/median_mm']:.1f} mm"
        ),
        prepare=prepare,
    )
