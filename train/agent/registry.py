"""Learners by the names that the command line and a run's JSON know.

A new learner is a file with its config and its class, and a line here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
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


def check_configs(learners: Mapping[str, Entry]) -> None:
    """Raise TypeError where two learners share a type of config: the type tells the learner in `name_of`."""
    by_type: dict[type[LearnerConfig], str] = {}
    for name, entry in learners.items():
        if (other := by_type.setdefault(entry.config, name)) != name:
            raise TypeError(
                f"LEARNERS: got {entry.config.__name__} for {other} and {name}, expected a type for each"
            )


check_configs(LEARNERS)


def name_of(config: LearnerConfig) -> str:
    """Return the name of the learner that a config is for."""
    return next(name for name, entry in LEARNERS.items() if type(config) is entry.config)


def learner_of(config: LearnerConfig, world: World) -> Learner:
    """Return the learner that a config is for."""
    return LEARNERS[name_of(config)].make(config, world)
