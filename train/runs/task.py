"""Tasks of a run: to reach the whole workspace, or to reach positions as an expert showed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from mjx_softarm.env import ReachEnv
from train.agent.registry import epoch_of, learns_from_demonstrations
from train.config import TrainConfig
from train.demos.demonstrations import Demonstrations
from train.epoch.job import FreshPoses, Job, State
from train.runs.evaluate import Evaluator
from train.runs.positions import PositionEvaluator


class Task(NamedTuple):
    """Job of a run, its evaluation, and what happens before each epoch."""

    job: Job
    evaluate: Evaluator | PositionEvaluator
    prepare: Callable[[State, int], State]  # state, number of epochs done -> state


def task_of(
    config: TrainConfig,
    env: ReachEnv,
    demonstrations: Demonstrations | None = None,
) -> Task:
    """Return the task of a run.

    Args:
        config: settings of the run.
        env: environment of its arms.
        demonstrations: demonstrations to learn from, for a learner from demonstrations.

    Raises:
        InputError: the learner needs demonstrations and has none.
    """
    epoch = epoch_of(config.learner, env, demonstrations)
    if learns_from_demonstrations(config.learner):
        return _at_positions(epoch, demonstrations)
    return Task(Job(epoch, fresh_poses(config, env)), Evaluator(env, epoch.learner), lambda state, k: state)


def fresh_poses(config: TrainConfig, env: ReachEnv) -> FreshPoses:
    """Return the pools of poses of a run."""
    return FreshPoses(env, config.fresh_poses_epochs, config.learner.n_epochs, config.seed)


def _at_positions(epoch: Any, demonstrations: Any) -> Task:
    job = Job(epoch)
    evaluate = PositionEvaluator(epoch.env, epoch.learner, demonstrations, epoch.goals.of_stage(0))

    def prepare(state: State, k: int) -> State:
        errors_mm = lambda: evaluate(job.policy(state))[0].error_mm  # noqa: E731
        return epoch.goals.prepare(state, k, errors_mm)

    return Task(job, evaluate, prepare)
