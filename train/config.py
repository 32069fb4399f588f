"""What a run is made of, as frozen data; presets; overrides; JSON."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import types
import typing
from dataclasses import dataclass, field
from typing import Any

from mjx_softarm._support.errors import InputError
from mjx_softarm.env import EnvConfig
from train.agent.gail import GailConfig
from train.agent.hindsight import HindsightConfig
from train.agent.tqc import TQCConfig


class ConfigError(InputError):
    """A setting that cannot be used; the message names it, what it got and what was expected."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run.

    Attributes:
        seed: of networks, exploration, goals and batches; the pool of poses has `env.workspace_seed`.
        n_arms: arms simulated side by side.
        episode_length: actions per episode at most.
        total_env_steps: actions of all arms together.
        updates_per_env_step: gradient steps per action of one arm.
        warmup_env_steps: actions drawn uniformly before the first gradient step.
        batch_size: transitions per gradient step.
        replay_capacity: transitions kept.
        vector_steps_per_epoch: actions of each arm between two reports.
        evaluation_epochs: epochs between two evaluations and checkpoints.
    """

    seed: int = 0
    n_arms: int = 128
    episode_length: int = 4
    total_env_steps: int = 300_000
    updates_per_env_step: float = 1.0
    warmup_env_steps: int = 2_048
    batch_size: int = 256
    replay_capacity: int = 400_000
    vector_steps_per_epoch: int = 16
    evaluation_epochs: int = 10
    env: EnvConfig = field(default_factory=EnvConfig)
    tqc: TQCConfig = field(default_factory=TQCConfig)
    hindsight: HindsightConfig = field(default_factory=HindsightConfig)

    def __post_init__(self) -> None:
        for name in (
            "n_arms",
            "episode_length",
            "total_env_steps",
            "batch_size",
            "vector_steps_per_epoch",
            "evaluation_epochs",
        ):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name}: got {getattr(self, name)}, expected at least 1")
        if self.warmup_env_steps < 0:
            raise ConfigError(f"warmup_env_steps: got {self.warmup_env_steps}, expected at least 0")
        if self.replay_capacity < self.n_arms:
            raise ConfigError(
                f"replay_capacity: got {self.replay_capacity}, expected at least n_arms = {self.n_arms}"
            )
        if self.n_updates_per_vector_step < 1:
            raise ConfigError(
                f"updates_per_env_step: got {self.updates_per_env_step}, expected at least one update per "
                f"step of all {self.n_arms} arms, {1 / self.n_arms:.4g}"
            )

    @property
    def n_updates_per_vector_step(self) -> int:
        return round(self.updates_per_env_step * self.n_arms)

    @property
    def n_epochs(self) -> int:
        return -(-self.total_env_steps // (self.n_arms * self.vector_steps_per_epoch))

    @property
    def n_updates(self) -> int:
        """Gradient steps of the whole run, warm-up epochs counted as if they had any."""
        return self.n_epochs * self.vector_steps_per_epoch * self.n_updates_per_vector_step

    def evaluates_after(self, epoch: int) -> bool:
        """Whether there is an evaluation and a checkpoint after so many epochs."""
        return epoch % self.evaluation_epochs == 0 or epoch == self.n_epochs


@dataclass(frozen=True)
class Stage:
    """A part of the schedule of learning from demonstrations."""

    share: float = 1.0  # of the run's environment steps
    every: int = 1  # each so many-th demonstrated position is a goal; 1 is all of them
    kept: float = 1.0  # share of what the replay holds that stays as the stage begins

    def __post_init__(self) -> None:
        if not 0.0 < self.share <= 1.0:
            raise ConfigError(f"stages: share: got {self.share}, expected more than 0 and at most 1")
        if self.every < 1:
            raise ConfigError(f"stages: every: got {self.every}, expected at least 1")
        if not 0.0 <= self.kept <= 1.0:
            raise ConfigError(f"stages: kept: got {self.kept}, expected 0 to 1")


@dataclass(frozen=True)
class ImitationConfig(TrainConfig):
    """A training run whose goals are demonstrated positions.

    Attributes:
        gail: the discriminator.
        learned_weight: of the learned reward; without it, of the demonstrations the positions alone are seen.
        hand_made_weight: of the environment's reward.
        frozen: the discriminator is another run's and stays as it is; of the demonstrations, the positions
            alone are seen then too.
        expert_share: of a batch of the critics that is the expert's, while the discriminator learns.
        stages: in order; their shares add up to 1.
        rebalance_env_steps: steps between two shifts of the goals towards those that are missed by most; 0
            is never.
    """

    gail: GailConfig = field(default_factory=GailConfig)
    learned_weight: float = 1.0
    hand_made_weight: float = 0.0
    frozen: bool = False
    expert_share: float = 0.25
    stages: tuple[Stage, ...] = (Stage(),)
    rebalance_env_steps: int = 0

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
        if self.env.mode != "quasistatic":
            raise ConfigError(f"env.mode: got {self.env.mode!r}, expected 'quasistatic' for demonstrations")

    @property
    def stage_epochs(self) -> tuple[int, ...]:
        """The epoch that each stage begins before."""
        shares = [0.0, *itertools.accumulate(stage.share for stage in self.stages[:-1])]
        return tuple(round(share * self.n_epochs) for share in shares)

    def evaluates_after(self, epoch: int) -> bool:
        """Likewise, and as each stage ends."""
        return super().evaluates_after(epoch) or epoch in self.stage_epochs

    @property
    def rebalance_epochs(self) -> int:
        """Epochs between two shifts of the goals; 0 is never."""
        return -(-self.rebalance_env_steps // (self.n_arms * self.vector_steps_per_epoch))


# Settings that made learning faster or finer.
_TUNED = TrainConfig(
    tqc=TQCConfig(
        gamma=0.5,
        learning_rate=1e-3,
        learning_rate_end=0.02,
        target_entropy=-30.0,
        reward_scale=0.1,
        initial_alpha=0.1,
    ),
    hindsight=HindsightConfig(reached_share=0.25, near_share=0.5),
)

PRESETS: dict[str, TrainConfig] = {
    # On a CPU a gradient step costs as much as many env steps, so there are eight of these to one of those,
    # and the batch is small.
    "quick": dataclasses.replace(
        _TUNED,
        total_env_steps=240_000,
        updates_per_env_step=0.125,
        batch_size=128,
        replay_capacity=262_144,
        evaluation_epochs=30,
    ),
    "paper": dataclasses.replace(_TUNED, total_env_steps=300_000, updates_per_env_step=0.5),
}

# The paper's schedules with a fifteenth or an eighth of its steps, which is enough. In the pipe, goals shift
# to the worst with each fifth of the run. Of the circle's 16 points 8 come first, then all, the environment's
# own reward beside the learned one, so that points between them stay where they are.
_PIPE = ImitationConfig(
    total_env_steps=40_000,
    updates_per_env_step=0.2,
    warmup_env_steps=1_024,
    replay_capacity=40_000,
    tqc=dataclasses.replace(_TUNED.tqc, learning_rate_alpha=1e-3, reward_scale=10.0, initial_alpha=0.02),
    hindsight=HindsightConfig(reached_share=0.0, near_share=0.0),
    rebalance_env_steps=8_000,
    evaluation_epochs=2,
)
_HAND_MADE = dataclasses.replace(
    _PIPE,
    learned_weight=0.0,
    hand_made_weight=1.0,
    tqc=dataclasses.replace(_TUNED.tqc, learning_rate_alpha=1e-3),
    hindsight=_TUNED.hindsight,
)
IMITATION_PRESETS: dict[str, ImitationConfig] = {
    "circle": dataclasses.replace(
        _HAND_MADE,
        tqc=dataclasses.replace(_HAND_MADE.tqc, learning_rate=3e-4),
        learned_weight=5.0,
        rebalance_env_steps=0,
        stages=(Stage(share=1 / 3, every=2), Stage(share=2 / 3, kept=0.2)),
    ),
    "pipe": _PIPE,
    "hand-made": _HAND_MADE,
    "frozen": dataclasses.replace(_HAND_MADE, learned_weight=5.0, frozen=True),
}
IMITATION_PRESETS_HELP = (
    "pipe: the learned reward; circle: both, in two stages; hand-made: the environment's reward at the "
    "same goals; frozen: that and another run's learned reward, with --reward; "
)


def override(config: Any, assignments: list[str]) -> Any:
    """A copy of a config with settings such as `tqc.gamma=0.95` changed, all of them at once.

    Raises:
        ConfigError: unknown setting, wrong type, or values that the config refuses.
    """
    texts: dict[str, str] = {}
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        if not equals:
            raise ConfigError(f"{assignment}: expected NAME=VALUE, for example tqc.gamma=0.95")
        texts[path] = text
    return _replace(config, {tuple(path.split(".")): text for path, text in texts.items()}, "")


def _replace(config: Any, texts: dict[tuple[str, ...], str], prefix: str) -> Any:
    """A copy with settings changed, which are given by their names from here on."""
    known, hints = [item.name for item in dataclasses.fields(config)], typing.get_type_hints(type(config))
    inner: dict[str, dict[tuple[str, ...], str]] = {}
    values = {}
    for (name, *names), text in texts.items():
        path = f"{prefix}{'.'.join((name, *names))}"
        if name not in known:
            raise ConfigError(f"{path}: unknown setting, expected one of {', '.join(known)}")
        value = getattr(config, name)
        if names and not dataclasses.is_dataclass(value):
            raise ConfigError(f"{path}: {name} has no settings of its own")
        if names:
            inner.setdefault(name, {})[tuple(names)] = text
        elif dataclasses.is_dataclass(value):
            settings = ", ".join(f"{path}.{item.name}" for item in dataclasses.fields(value))
            raise ConfigError(f"{path}: a group, expected one of {settings}")
        else:
            values[name] = _parse(text, hints[name], path)
    values |= {
        name: _replace(getattr(config, name), those, f"{prefix}{name}.") for name, those in inner.items()
    }
    try:
        return dataclasses.replace(config, **values)
    except ValueError as error:
        given = ", ".join(f"{prefix}{'.'.join(names)}={text}" for names, text in texts.items())
        raise ConfigError(f"{given}: {error}") from error


def _parse(text: str, kind: Any, path: str) -> Any:
    """A value of the setting's type from its text; JSON but for bare words."""
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        value = text
    return _coerce(value, kind, path)


def _coerce(value: Any, kind: Any, path: str) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        kind = next(argument for argument in arguments if argument is not type(None))
        origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Literal and value in arguments:
        return value
    if dataclasses.is_dataclass(kind) and isinstance(value, dict):
        return _from_dict(kind, value, path)
    if origin is tuple and isinstance(value, list):
        return tuple(_coerce(item, arguments[0], path) for item in value)
    if kind is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if isinstance(kind, type) and type(value) is kind:
        return value
    raise ConfigError(f"{path}: got {value!r}, expected {getattr(kind, '__name__', kind)}")


def to_dict(config: TrainConfig) -> dict[str, Any]:
    """Nested dictionaries for JSON; tuples become lists."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_dict(data: dict[str, Any]) -> TrainConfig:
    """The config that `to_dict` gave; of learning from demonstrations where it has their settings.

    Raises:
        ConfigError: a setting is missing, unknown or of the wrong type.
    """
    return _from_dict(ImitationConfig if "stages" in data else TrainConfig, data, "config")


def _from_dict(cls: Any, data: Any, path: str) -> Any:
    hints = typing.get_type_hints(cls)
    if not isinstance(data, dict) or data.keys() != hints.keys():
        got = sorted(data) if isinstance(data, dict) else data
        raise ConfigError(f"{path}: got {got}, expected the settings {sorted(hints)}")
    values = {
        name: _from_dict(kind, data[name], f"{path}.{name}")
        if dataclasses.is_dataclass(kind)
        else _coerce(data[name], kind, f"{path}.{name}")
        for name, kind in hints.items()
    }
    return cls(**values)
