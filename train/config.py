"""Settings of a training run, presets, and both as JSON."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import typing
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Self

from tyro.constructors import PrimitiveConstructorSpec

from mjx_softarm._support.errors import InputError
from mjx_softarm.env import EnvConfig
from mjx_softarm.mdp.actions import N_ACTIONS
from train.agent.analytic import AnalyticConfig
from train.agent.gail import GailConfig
from train.agent.hindsight import HindsightConfig
from train.agent.tqc import TQCConfig

LEARNER_GROUPS = {"tqc": ("tqc", "hindsight"), "analytic": ("analytic",)}  # settings that a learner reads


class ConfigError(InputError):
    """A setting that cannot be used; the message names it, what it got and what was expected."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run that reaches poses."""

    learner: Literal["tqc", "analytic"] = "tqc"
    """tqc: from transitions, by critics; analytic: by the gradient of the simulation"""
    seed: int = 0
    """seed of networks, exploration, goals and batches; the pool of poses has env.workspace_seed"""
    n_arms: int = 128
    """arms simulated side by side"""
    episode_length: int = N_ACTIONS
    """actions per episode at most"""
    total_env_steps: int = 300_000
    """actions of all arms together"""
    updates_per_env_step: float = 1.0
    """gradient steps per action of one arm"""
    warmup_env_steps: int = 2_048
    """actions drawn uniformly before the first gradient step"""
    batch_size: int = 256
    """transitions per gradient step"""
    replay_capacity: int = 400_000
    """transitions kept"""
    vector_steps_per_epoch: int = 16
    """actions of each arm between two reports"""
    evaluation_epochs: int = 10
    """epochs between two evaluations and checkpoints"""
    env: EnvConfig = field(default_factory=EnvConfig)
    """environment"""
    tqc: TQCConfig = field(default_factory=TQCConfig)
    """actor and critics"""
    hindsight: HindsightConfig = field(default_factory=HindsightConfig)
    """relabelled goals, as shares of a batch; the rest keeps its own goals"""
    analytic: AnalyticConfig = field(default_factory=AnalyticConfig)
    """policy and descent of the analytic learner"""

    def __post_init__(self) -> None:
        counts = ("n_arms", "episode_length", "total_env_steps", "batch_size")
        least = dict.fromkeys((*counts, "vector_steps_per_epoch", "evaluation_epochs"), 1)
        for name, low in {**least, "seed": 0, "warmup_env_steps": 0}.items():
            if getattr(self, name) < low:
                raise ConfigError(f"{name}: got {getattr(self, name)}, expected at least {low}")
        given_kg = self.env.randomisation.payload_max_kg
        if self.env.observation == "payload" and given_kg is not None:
            raise ConfigError(
                f"env.randomisation.payload_max_kg: got {given_kg:g} with env.observation 'payload', "
                "expected none: it is the arm's largest, since the loop may estimate so much"
            )
        if self.replay_capacity < self.n_arms:
            raise ConfigError(
                f"replay_capacity: got {self.replay_capacity}, expected at least n_arms = {self.n_arms}"
            )
        if not math.isfinite(self.updates_per_env_step) or self.n_updates_per_vector_step < 1:
            raise ConfigError(
                f"updates_per_env_step: got {self.updates_per_env_step}, expected a finite number of at "
                f"least one update per step of all {self.n_arms} arms, {1 / self.n_arms:.4g}"
            )

    @property
    def n_updates_per_vector_step(self) -> int:
        if self.learner == "analytic":  # it learns from the action itself
            return 1
        return round(self.updates_per_env_step * self.n_arms)

    @property
    def n_epochs(self) -> int:
        """Number of epochs of the run."""
        return -(-self.total_env_steps // (self.n_arms * self.vector_steps_per_epoch))

    @property
    def n_updates(self) -> int:
        """Number of the learner's gradient steps, warm-up epochs counted as if they had any."""
        return self.n_epochs * self.vector_steps_per_epoch * self.n_updates_per_vector_step

    @property
    def policy_hidden(self) -> tuple[int, ...]:
        """Width of each hidden layer of the learner's policy."""
        return self.analytic.hidden if self.learner == "analytic" else self.tqc.hidden_actor

    def with_policy_of(self, donor: TrainConfig) -> Self:
        """Return these settings with hidden layers of the policy as in a run that it is taken from."""
        return dataclasses.replace(
            self,
            tqc=dataclasses.replace(self.tqc, hidden_actor=donor.policy_hidden),
            analytic=dataclasses.replace(self.analytic, hidden=donor.policy_hidden),
        )

    def evaluates_after(self, epoch: int) -> bool:
        """Return whether an evaluation and a checkpoint follow the n-th epoch."""
        return epoch % self.evaluation_epochs == 0 or epoch == self.n_epochs


@dataclass(frozen=True)
class Stage:
    """A part of the schedule of learning from demonstrations."""

    share: float = 1.0  # share of the run's environment steps
    every: int = 1  # every n-th demonstrated pose is a goal; 1 is all of them
    kept: float = 1.0  # share of the replay's transitions that is kept as the stage begins

    def __post_init__(self) -> None:
        if not 0.0 < self.share <= 1.0:
            raise ConfigError(f"stages: share: got {self.share}, expected more than 0 and at most 1")
        if self.every < 1:
            raise ConfigError(f"stages: every: got {self.every}, expected at least 1")
        if not 0.0 <= self.kept <= 1.0:
            raise ConfigError(f"stages: kept: got {self.kept}, expected 0 to 1")


def _stages(words: list[str]) -> tuple[Stage, ...]:
    stages = []
    for word in words:
        numbers = word.split(",")
        if len(numbers) != 3:
            raise ValueError(f"got {word!r}, expected SHARE,EVERY,KEPT")
        stages.append(Stage(float(numbers[0]), int(numbers[1]), float(numbers[2])))
    return tuple(stages)


_STAGES_OPTION = PrimitiveConstructorSpec(
    nargs="*",
    metavar="SHARE,EVERY,KEPT",
    instance_from_str=_stages,
    is_instance=lambda value: isinstance(value, tuple),
    str_from_instance=lambda stages: [f"{stage.share:.3g},{stage.every},{stage.kept:g}" for stage in stages],
)


@dataclass(frozen=True)
class ImitationConfig(TrainConfig):
    """A training run whose goals are demonstrated poses."""

    gail: GailConfig = field(default_factory=GailConfig)
    """discriminator"""
    learned_weight: float = 1.0
    """weight of the learned reward; with 0, only the poses of the demonstrations are used"""
    hand_made_weight: float = 0.0
    """weight of the environment's reward"""
    frozen: bool = False
    """keep the discriminator of another run as it is; only the poses of the demonstrations are used"""
    expert_share: float = 0.25
    """share of the critics' batches that is the expert's; in motion, share of the arms' actions"""
    stages: Annotated[tuple[Stage, ...], _STAGES_OPTION] = (Stage(),)
    """stages in order: share of the env steps (all add up to 1), every n-th pose is a goal, share of the
    replay that is kept as the stage begins"""
    rebalance_env_steps: int = 0
    """env steps between two shifts of the goals towards those missed by most; 0 is never"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.expert_share < 1.0:
            raise ConfigError(f"expert_share: got {self.expert_share}, expected 0 or more and less than 1")
        if min(self.learned_weight, self.hand_made_weight) < 0:
            raise ConfigError(
                f"learned_weight, hand_made_weight: got {self.learned_weight}, {self.hand_made_weight}, "
                "expected numbers >= 0"
            )
        if self.learned_weight == self.hand_made_weight == 0:
            raise ConfigError("learned_weight, hand_made_weight: got 0 for both, expected some reward")
        total = sum(stage.share for stage in self.stages)
        if not math.isclose(total, 1.0, abs_tol=1e-6):
            raise ConfigError(f"stages: got shares that add up to {total:g}, expected 1")
        if len(set(self.stage_epochs)) < len(self.stages):
            raise ConfigError(
                f"stages: got stages that begin before epochs {self.stage_epochs}, expected an epoch or more "
                f"for each; there are {self.n_epochs}"
            )
        if self.rebalance_env_steps < 0:
            raise ConfigError(f"rebalance_env_steps: got {self.rebalance_env_steps}, expected at least 0")
        if self.env.observation == "payload":  # an action that was shown is right for one payload
            expected = "'pose' or 'motion' for demonstrations"
            raise ConfigError(f"env.observation: got 'payload', expected {expected}")
        if self.learner != "tqc":
            raise ConfigError(f"learner: got {self.learner!r}, expected 'tqc' for demonstrations")

    @property
    def stage_epochs(self) -> tuple[int, ...]:
        """Number of epochs before each stage."""
        shares = [0.0, *itertools.accumulate(stage.share for stage in self.stages[:-1])]
        return tuple(round(share * self.n_epochs) for share in shares)

    def evaluates_after(self, epoch: int) -> bool:
        """Return whether to evaluate after this epoch: every n-th, and at the end of each stage."""
        return super().evaluates_after(epoch) or epoch in self.stage_epochs

    @property
    def rebalance_epochs(self) -> int:
        """Number of epochs between two shifts of the goals; 0 is never."""
        return -(-self.rebalance_env_steps // (self.n_arms * self.vector_steps_per_epoch))


def override(config: Any, assignments: Sequence[str]) -> Any:
    """Return a copy of a config with settings such as `tqc.gamma=0.95` changed, all of them at once.

    Raises:
        ConfigError: a setting is unknown or of the wrong type, or the config refuses its value.
    """
    data = to_dict(config)
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        *groups, name = path.replace("-", "_").split(".")
        settings: Any = data
        for group in groups:
            settings = settings.get(group) if isinstance(settings, dict) else None
        if not equals or not isinstance(settings, dict) or isinstance(settings.get(name, {}), dict):
            known = ", ".join(settings if isinstance(settings, dict) else data)
            raise ConfigError(f"{path}: got {assignment!r}, expected NAME=VALUE for one of {known}")
        try:
            settings[name] = json.loads(text)
        except json.JSONDecodeError:  # a bare word
            settings[name] = text
    return _read(type(config), data, "")


def to_dict(config: TrainConfig) -> dict[str, Any]:
    """Return nested dictionaries for JSON; tuples become lists."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_dict(data: dict[str, Any]) -> TrainConfig:
    """Return the config that `to_dict` gave; an `ImitationConfig` where its settings are there.

    A setting that is missing, as in a run of before it was added, has its default.

    Raises:
        ConfigError: a setting is unknown or of the wrong type.
    """
    return _read(ImitationConfig if "stages" in data else TrainConfig, data, "config")


def _read(kind: Any, value: Any, path: str) -> Any:
    """Return the value of a setting, or of a group of settings, whose type is `kind`, from what JSON gave."""
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        hints = typing.get_type_hints(kind)
        if not isinstance(value, dict) or not value.keys() <= hints.keys():
            got = sorted(value) if isinstance(value, dict) else value
            raise ConfigError(f"{path}: got {got}, expected the settings {sorted(hints)}")
        prefix = f"{path}." if path else ""
        values = {name: _read(hints[name], item, prefix + name) for name, item in value.items()}
        try:
            return kind(**values)
        except ValueError as error:
            raise ConfigError(str(error)) from error
    if typing.get_origin(kind) is tuple and isinstance(value, list):
        return tuple(_read(typing.get_args(kind)[0], item, path) for item in value)
    allowed = typing.get_args(kind) or (kind,)  # types of a union, or values of a Literal
    if float in allowed and type(value) is int:
        return float(value)
    if type(value) not in allowed and value not in allowed:
        names = ", ".join(getattr(item, "__name__", repr(item)) for item in allowed)
        raise ConfigError(f"{path}: got {value!r}, expected {names}")
    return value
