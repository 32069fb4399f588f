"""Ways to find references, trials of them on twins, and where each has its files in the folder."""

from __future__ import annotations

from typing import NamedTuple

EVALUATION_FILE, POLICY_FILE = "evaluation.json", "policy.npz"


class Kind(NamedTuple):
    """A way to find references: a solver, a policy, or a policy learned from demonstrations."""

    title: str
    task: str = ""  # of `train.demos.waypoints.TASKS`, whose demonstrations it learns from
    preset: str = ""  # of `python -m train imitate`
    settings: tuple[str, ...] = ()  # NAME=VALUE
    reward_of: str = ""  # kind whose learned reward it takes, unchanged
    from_reach: bool = False  # begins with the policy that was trained without demonstrations


KINDS = {
    "specified": Kind("specification alone"),
    "without": Kind("without S2R"),
    "with": Kind("with S2R"),
    "gradient": Kind("gradient descent"),
    "pipe": Kind("learned reward", "pipe300", "pipe"),
    "moving": Kind("learned reward, in motion", "pipe300", "pipe-moving"),
    "hand-made": Kind("hand-made reward", "pipe300", "hand-made"),
    "no-penalty": Kind("no gradient penalty", "pipe300", "pipe", ("gail.gradient_penalty=0",)),
    "narrow": Kind("hand-made, and learned in the wide pipe", "pipe250", "frozen", reward_of="pipe"),
    "circle": Kind("with demonstrations", "circle16", "circle", from_reach=True),
}
TASKS = ("pipe300", "pipe250", "circle16")


class Trial(NamedTuple):
    """One run on a twin."""

    kind: str  # key of KINDS
    twin: int
    seed: int  # of training
    objects: str = ""  # in the containers: key of `measure.OBJECTS_KG`, "" without demonstrations
    load_g: int = 0  # payload that the policy does not know
    moves: bool = False  # past the positions between the objects, without a stop

    @property
    def variant(self) -> str:
        return (self.objects or f"{self.load_g} g") + " in motion" * self.moves

    @property
    def name(self) -> str:
        return f"{self.kind}-twin{self.twin}-seed{self.seed}-{self.variant.replace(' ', '-')}"

    @property
    def result(self) -> str:
        return f"trials/{self.name}.npz"


def arm_name(twin: int | None) -> str:
    """Return the name of a twin, or of the nominal arm, in paths."""
    return "nominal" if twin is None else f"twin{twin}"


def reach_run(twin: int | None, seed: int) -> str:
    """Return the run folder of a policy without demonstrations; None is the nominal arm."""
    return f"{arm_name(twin)}-seed{seed}"


def learned_run(kind: str, twin: int, seed: int) -> str:
    """Return the run folder of a policy learned from demonstrations."""
    return f"{kind}-twin{twin}-seed{seed}"
