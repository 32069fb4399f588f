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
    begins_with: str = ""  # kind whose policy it begins with
    reach: str = ""  # preset of `python -m train reach`, beside that of the experiment


# The environment's reward in the place of the learned one, with hindsight; and both.
HAND_MADE = (
    "learner.learned_weight=0",
    "learner.hand_made_weight=1",
    "learner.expert_share=0",
    "learner.reward_scale=0.1",
    "learner.initial_alpha=0.1",
    "learner.hindsight.reached_share=0.25",
    "learner.hindsight.near_share=0.5",
)
BOTH = (*HAND_MADE[1:], "learner.learned_weight=5")
KINDS = {
    "specified": Kind("specification alone"),
    "without": Kind("calibrated springs"),
    "chambers": Kind("calibrated springs and chambers"),
    "with": Kind("with S2R"),
    "quick": Kind("with S2R, quick", reach="quick"),
    "analytic": Kind("with S2R, analytic", reach="analytic"),
    "payload": Kind("with S2R, payload", reach="payload"),
    "gradient": Kind("gradient descent"),
    "pipe": Kind("learned reward", "pipe300", "pipe"),
    "moving": Kind("learned reward, in motion", "pipe300", "pipe-moving"),
    "hand-made": Kind("hand-made reward", "pipe300", "pipe", HAND_MADE),
    "narrow": Kind("hand-made, and learned in the wide pipe", "pipe250", "pipe", BOTH, reward_of="pipe"),
    "narrow-learned": Kind(
        "learned in the wide pipe",
        "pipe250",
        "pipe",
        (*BOTH, "learner.hand_made_weight=0"),
        reward_of="pipe",
    ),
    "narrow-hand-made": Kind("hand-made reward", "pipe250", "pipe", HAND_MADE),
    "circle": Kind("with demonstrations", "circle16", "circle", begins_with="quick"),
}
TASKS = ("pipe300", "pipe250", "circle16")
BESIDE = tuple(name for name, kind in KINDS.items() if kind.reach)


class Trial(NamedTuple):
    """One run on a twin."""

    kind: str  # key of KINDS
    twin: int
    seed: int  # of training
    objects: str = ""  # in the containers: key of `measure.OBJECTS_KG`, "" without demonstrations
    load_g: int = 0  # payload
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
    """Return the run folder of a policy of a kind's own: of another preset, or from demonstrations."""
    return f"{kind}-{reach_run(twin, seed)}"


def run_of(trial: Trial) -> str:
    """Return the run folder of a trial's policy, or of the one that its solver takes the arm from."""
    if trial.kind == "specified":
        return reach_run(None, trial.seed)
    own = f"{trial.kind}-" if trial.kind not in ("without", "with", "gradient") else ""
    return own + reach_run(trial.twin, trial.seed)
