"""Learners by the names that the command line and a run's JSON know.

A new learner is a file with its config and its class, and a line here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from jax.sharding import Mesh

from mjx_softarm.env import ReachEnv
from train.agent.analytic import Analytic, AnalyticConfig
from train.agent.imitation import Imitation, ImitationConfig
from train.agent.learner import Learner, LearnerConfig
from train.agent.tqc import HindsightTQC, TQCConfig
from train.demos.demonstrations import Demonstrations


class World(NamedTuple):
    """Environment of a learner, with devices and demonstrations where there are any."""

    env: ReachEnv
    mesh: Mesh | None = None
    demonstrations: Demonstrations | None = None


class Entry(NamedTuple):
    """A learner: its config's type, and the function that makes it of a config."""

    config: type[LearnerConfig]
    make: Callable[[Any, World], Learner]
    from_demonstrations: bool = False  # whether its goals are demonstrated poses, as `train imitate` has them


LEARNERS = {
    "tqc": Entry(TQCConfig, lambda config, world: HindsightTQC(config, world.env)),
    "analytic": Entry(AnalyticConfig, lambda config, world: Analytic(config, world.env, world.mesh)),
    "imitation": Entry(
        ImitationConfig,
        lambda config, world: Imitation(config, world.env, world.demonstrations),
        from_demonstrations=True,
    ),
}

# A config's type tells its learner, in `name_of` and in a run's JSON.
if len({entry.config for entry in LEARNERS.values()}) < len(LEARNERS):
    raise TypeError("LEARNERS: got two learners with one type of config, expected a type of its own for each")


def name_of(config: LearnerConfig) -> str:
    """Return the name of the learner that a config is for."""
    return next(name for name, entry in LEARNERS.items() if type(config) is entry.config)


def learner_of(config: LearnerConfig, world: World) -> Learner:
    """Return the learner that a config is for."""
    return LEARNERS[name_of(config)].make(config, world)
