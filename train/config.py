"""Settings of a training run: those of its learner and the few that all runs share; both as JSON."""

from __future__ import annotations

import dataclasses
import json
import typing
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Self

from mjx_softarm._support.errors import InputError
from mjx_softarm._support.fields import Count, Number, check_ranges
from mjx_softarm.env import EnvConfig
from train.agent.analytic import AnalyticConfig
from train.agent.imitation import ImitationConfig
from train.agent.learner import LearnerConfig
from train.agent.tqc import TQCConfig

# Configs of the learners, by the names that the command line and a run's JSON know.
LEARNERS: dict[str, type[LearnerConfig]] = {
    "tqc": TQCConfig,
    "analytic": AnalyticConfig,
    "imitation": ImitationConfig,
}


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training run."""

    learner: LearnerConfig = field(default_factory=TQCConfig)
    """settings of the learner"""
    seed: Number = 0
    """seed of networks, exploration, goals, batches, and of poses that are drawn anew"""
    evaluation_epochs: Count = 10
    """epochs between two evaluations and checkpoints"""
    fresh_poses_epochs: Number = 0
    """epochs after which other poses take the place of env.n_poses, for starts and goals; 0: never"""
    env: EnvConfig = field(default_factory=EnvConfig)
    """environment"""

    def __post_init__(self) -> None:
        check_ranges("", self)
        given_kg = self.env.randomisation.payload_max_kg
        if self.env.observation == "payload" and given_kg is not None:
            raise InputError(
                f"env.randomisation.payload_max_kg: got {given_kg:g} with env.observation 'payload', "
                "expected none: it is the arm's largest, since the loop may estimate so much"
            )
        self.learner.check(self.env)

    def with_policy_of(self, donor: TrainConfig) -> Self:
        """Return these settings for a run that begins with another's policy, with its hidden layers."""
        of_policy = {name: getattr(donor.learner, name) for name in ("hidden", "activation")}
        return dataclasses.replace(self, learner=dataclasses.replace(self.learner, **of_policy))

    def evaluates_after(self, epoch: int) -> bool:
        """Return whether an evaluation and a checkpoint follow the n-th epoch."""
        last = self.learner.n_epochs
        return epoch % self.evaluation_epochs == 0 or epoch in (last, *self.learner.stage_epochs)


def override(config: TrainConfig, assignments: Sequence[str]) -> TrainConfig:
    """Return a copy of a config with settings such as `learner.gamma=0.95` changed, all of them at once.

    Raises InputError for a setting that is unknown or of the wrong type, or that the config refuses.
    """
    data = to_dict(config)
    for assignment in assignments:
        # Find the group of settings that the path leads to.
        path, equals, text = assignment.partition("=")
        *groups, name = path.replace("-", "_").split(".")
        settings: Any = data
        for group in groups:
            settings = settings.get(group) if isinstance(settings, dict) else None
        if not equals or not isinstance(settings, dict) or isinstance(settings.get(name, {}), dict):
            known = ", ".join(settings if isinstance(settings, dict) else data)
            raise InputError(f"{path}: got {assignment!r}, expected NAME=VALUE for one of {known}")
        # Set the value: JSON, or a bare word.
        try:
            settings[name] = json.loads(text)
        except json.JSONDecodeError:
            settings[name] = text
    return _read(TrainConfig, data, "")


def name_of(learner: LearnerConfig) -> str:
    """Return the name of the learner that a config is for."""
    return next(name for name, kind in LEARNERS.items() if type(learner) is kind)


def to_dict(config: TrainConfig) -> dict[str, Any]:
    """Return nested dictionaries for JSON, the learner's with its name; tuples become lists."""
    data = dataclasses.asdict(config)
    data["learner"] = {"name": name_of(config.learner), **data["learner"]}
    return json.loads(json.dumps(data))


def from_dict(data: dict[str, Any]) -> TrainConfig:
    """Return the config that `to_dict` gave; a setting that is missing has its default.

    Raises InputError for a setting that is unknown or of the wrong type.
    """
    return _read(TrainConfig, data, "config")


def _read(kind: Any, value: Any, path: str) -> Any:
    """Return the value of a setting, or of a group of settings, whose type is `kind`, from what JSON gave."""
    # A learner: the type of its config follows from its name.
    if kind is LearnerConfig and isinstance(value, dict):
        name, value = value.get("name"), {key: item for key, item in value.items() if key != "name"}
        if name not in LEARNERS:
            raise InputError(f"{path}.name: got {name!r}, expected one of {', '.join(LEARNERS)}")
        kind = LEARNERS[name]
    # A group of settings.
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        hints = typing.get_type_hints(kind)
        fields = [item.name for item in dataclasses.fields(kind)]
        if not isinstance(value, dict) or not value.keys() <= set(fields):
            got = sorted(value.keys() - set(fields)) if isinstance(value, dict) else value
            raise InputError(f"{path}: got {got}, expected the settings {sorted(fields)}")
        prefix = f"{path}." if path else ""
        values = {name: _read(hints[name], item, prefix + name) for name, item in value.items()}
        try:
            return kind(**values)
        except ValueError as error:
            raise InputError(str(error)) from error
    # A single setting: one of the types of a union, or of the values of a Literal.
    if typing.get_origin(kind) is tuple and isinstance(value, list):
        return tuple(_read(typing.get_args(kind)[0], item, path) for item in value)
    allowed = typing.get_args(kind) or (kind,)
    if float in allowed and type(value) is int:
        return float(value)
    if type(value) not in allowed and value not in allowed:
        names = ", ".join(getattr(item, "__name__", repr(item)) for item in allowed)
        raise InputError(f"{path}: got {value!r}, expected {names}")
    return value
