"""The two things that a run can learn: to reach the workspace, or to reach as an expert showed.

A task is a job with all that differs around it: how it is evaluated, shown, and prepared for an epoch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from jax.sharding import Mesh
from matplotlib.figure import Figure

from mjx_softarm.env import ReachEnv
from train.config import ImitationConfig, TrainConfig
from train.demos.demonstrations import Demonstrations
from train.epoch.imitation import ImitationJob
from train.epoch.job import Job, TrainState
from train.runs import plots
from train.runs.evaluate import N_GOALS, Evaluator
from train.runs.positions import PositionEvaluator


class Task(NamedTuple):
    """What a run learns."""

    job: Job
    title: str  # of the table of figures
    evaluate: Callable[[Any], tuple[Any, ...]]  # actor -> figures (`to_dict`), and what was reached
    picture_names: tuple[str, ...]
    pictures: Callable[..., dict[str, Figure]]  # rows of metrics, what was reached -> by those names
    headline: Callable[[dict[str, float]], str]  # row of metrics with an evaluation -> a few words
    prepare: Callable[[TrainState, int], TrainState]  # before the epoch of that number


def task_of(
    config: TrainConfig,
    env: ReachEnv,
    demonstrations: Demonstrations | None = None,
    mesh: Mesh | None = None,
) -> Task:
    """What a run of this config learns; demonstrations are needed where it learns from them.

    Raises:
        ConfigError: it cannot be split evenly over the devices of the mesh.
    """
    if isinstance(config, ImitationConfig):
        assert demonstrations is not None
        return _imitation(config, env, demonstrations, mesh)
    job = Job(config, env, mesh)
    return Task(
        job=job,
        title=f"{N_GOALS} held-out goals",
        evaluate=Evaluator(env, job.agent),
        picture_names=plots.REACH_PICTURES,
        pictures=plots.reach_pictures,
        headline=lambda row: f"held-out median {row['evaluation/median_mm']:.1f} mm",
        prepare=lambda state, epoch: state,
    )


def _imitation(
    config: ImitationConfig, env: ReachEnv, demonstrations: Demonstrations, mesh: Mesh | None
) -> Task:
    job = ImitationJob(config, env, demonstrations, mesh)
    evaluate = PositionEvaluator(env, job.agent, demonstrations.positions, job.goals_of(0))

    def prepare(state: TrainState, epoch: int) -> TrainState:
        every = config.rebalance_epochs
        if every and epoch and epoch % every == 0 and epoch not in config.stage_epochs:
            summary, _ = evaluate(state.agent.mean_actor_params)
            state = job.rebalance(state, epoch, summary.error_mm)
        else:
            state = job.begin_stage(state, epoch)
        return job.place(state)

    return Task(
        job=job,
        title=f"{len(demonstrations.positions)} demonstrated positions",
        evaluate=evaluate,
        picture_names=plots.IMITATION_PICTURES,
        pictures=plots.imitation_pictures,
        headline=lambda row: (
            f"success at {100 * row['evaluation/success_share']:.0f} % of the positions, "
            f"median {row['evaluation/median_mm']:.1f} mm"
        ),
        prepare=prepare,
    )
