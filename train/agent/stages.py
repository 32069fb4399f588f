"""Stages of learning from demonstrations, and how the command line reads them."""

from __future__ import annotations

from dataclasses import dataclass

from tyro.constructors import PrimitiveConstructorSpec

from train.agent.learner import check_settings


@dataclass(frozen=True)
class GoalStage:
    """A part of the schedule of demonstrated goals."""

    share: float = 1.0  # share of the run's environment steps
    every: int = 1  # every n-th demonstrated pose is a goal; 1 is all of them
    kept: float = 1.0  # share of the replay's transitions that is kept as the stage begins

    def __post_init__(self) -> None:
        required = {
            "share": (0.0 < self.share <= 1.0, "more than 0 and at most 1"),
            "every": (self.every >= 1, "at least 1"),
            "kept": (0.0 <= self.kept <= 1.0, "0 to 1"),
        }
        check_settings("learner.stages", self, required)


def _stages(words: list[str]) -> tuple[GoalStage, ...]:
    stages = []
    for word in words:
        numbers = word.split(",")
        if len(numbers) != 3:
            raise ValueError(f"got {word!r}, expected SHARE,EVERY,KEPT")
        stages.append(GoalStage(float(numbers[0]), int(numbers[1]), float(numbers[2])))
    return tuple(stages)


STAGES_OPTION = PrimitiveConstructorSpec(
    nargs="*",
    metavar="SHARE,EVERY,KEPT",
    instance_from_str=_stages,
    is_instance=lambda value: isinstance(value, tuple),
    str_from_instance=lambda stages: [f"{stage.share:.3g},{stage.every},{stage.kept:g}" for stage in stages],
)
