"""Learners by the names that the command line and a run's JSON know.

A new learner is a file with its config and its class, and a line here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from mjx_softarm._support.errors import InputError
from mjx_softarm.env import ReachEnv
from train.agent.analytic import AnalyticConfig, GradientEpoch
from train.agent.imitation import DemonstratedGoals, Imitation, ImitationConfig
from train.agent.learner import LearnerConfig
from train.agent.tqc import TQC, TQCConfig
from train.demos.demonstrations import Demonstrations
from train.epoch.job import Epoch
from train.epoch.replay_epoch import Learner, ReplayEpoch


class Entry(NamedTuple):
    """A learner: its config's type, and the function that makes its epoch."""

    config: type[LearnerConfig]
    epoch: Callable[[Any, ReachEnv, Demonstrations | None], Epoch]
    from_demonstrations: bool = False  # whether its goals are demonstrated poses, as `train imitate` has them


def with_replay(learner: Callable[[int, int, Any], Learner]) -> Callable[..., Epoch]:
    """Return the function that makes the epoch of a learner from the replay.

    Args:
        learner: its class, called with the sizes of observation and action and with its config.
    """

    def epoch(config: Any, env: ReachEnv, _: Demonstrations | None) -> Epoch:
        return ReplayEpoch(config, env, learner(env.observation_size, env.action_size, config))

    return epoch


def _gradient(config: Any, env: ReachEnv, _: Demonstrations | None) -> Epoch:
    return GradientEpoch(config, env)


def _imitation(config: Any, env: ReachEnv, shown: Demonstrations | None) -> Epoch:
    if shown is None:
        raise InputError("learner: got 'imitation' without demonstrations, expected a file of them")
    return ReplayEpoch(config, env, Imitation(config, env, shown), DemonstratedGoals(config, env, shown))


LEARNERS = {
    "tqc": Entry(TQCConfig, with_replay(TQC)),
    "analytic": Entry(AnalyticConfig, _gradient),
    "imitation": Entry(ImitationConfig, _imitation, from_demonstrations=True),
}
# `name_of` finds a learner by the type of its config
if len({entry.config for entry in LEARNERS.values()}) < len(LEARNERS):
    raise TypeError("LEARNERS: got two learners with one type of config, expected a type for each")


def name_of(config: LearnerConfig) -> str:
    """Return the name of the learner that a config is for."""
    return next(name for name, entry in LEARNERS.items() if type(config) is entry.config)


def learns_from_demonstrations(config: LearnerConfig) -> bool:
    """Return whether the goals of a config's learner are demonstrated poses."""
    return LEARNERS[name_of(config)].from_demonstrations


def epoch_of(config: LearnerConfig, env: ReachEnv, shown: Demonstrations | None = None) -> Epoch:
    """Return the epoch of the learner that a config is for.

    Args:
        config: settings of the learner.
        env: the arm.
        shown: demonstrations, for a learner from these.

    Raises:
        InputError: demonstrations are missing.
    """
    return LEARNERS[name_of(config)].epoch(config, env, shown)
