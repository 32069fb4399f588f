"""Parts that the paper's experiments compare: settings, ways to find references, trials, and their files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

EXPERIMENTS = ("open", "confined", "independence")
CALIBRATION, POLICY_FILE = "calibration", "policy.npz"
MORE = ("twins", "seeds", "loads_g", "beside")  # settings that results in a folder may differ in
IN_TIME_S = (10.0, 20.0, 40.0)  # durations of one lap of the circle without a stop
N_IN_TIME = 80  # points of this circle
TRACED_G = (0, 500, 1000)  # payloads whose laps are drawn over time


@dataclass(frozen=True)
class Settings:
    """Size of the experiments, and how policies are trained."""

    arm: Literal["twin", "rod"] = "twin"  # stand-in for an arm; a rod in open space alone
    twins: tuple[int, ...] = (0, 1, 2)  # their seeds
    seeds: tuple[int, ...] = (0, 1, 2)  # of training
    beside: tuple[str, ...] = ()  # further kinds in open space, keys of `BESIDE`
    reach: tuple[str, ...] = ()  # further settings of `train reach`, NAME=VALUE
    imitation: tuple[str, ...] = ()  # further settings of `train imitate`, NAME=VALUE
    n_poses: int = 500  # of a calibration's log
    n_points: int = 40  # of the circle
    n_positions: int | None = None  # of a pipe's task, from the first; None is all
    loads_g: tuple[int, ...] = (35, 105, 220, 330, 500, 1000)
    independence_steps: int = 262_144  # environment steps of each training of `independence`
    n_goals: int = 2000  # held-out goals of each of its two sets

    @property
    def runs(self) -> list[tuple[int, int]]:
        """All pairs of a twin and a training seed."""
        return [(twin, seed) for twin in self.twins for seed in self.seeds]


SMOKE = Settings(
    twins=(0,),
    seeds=(0,),
    reach=("learner.total_env_steps=512", "learner.n_arms=16"),
    imitation=(
        *("learner.total_env_steps=512", "learner.n_arms=16", "learner.updates_per_env_step=0.25"),
        "learner.warmup_env_steps=128",
    ),
    n_poses=80,
    n_points=4,
    n_positions=7,  # up to the first object
    loads_g=(500, 1000),
    independence_steps=1024,
    n_goals=8,
)


class Kind(NamedTuple):
    """A way to find references: a solver, a policy, or a policy learned from demonstrations."""

    title: str
    preset: str = "analytic"  # of `python -m train reach`, or of `imitate` where there is a task
    task: str = ""  # key of `mjx_softarm.mechanics.pipe.PIPES`, whose demonstrations it learns from
    settings: tuple[str, ...] = ()  # NAME=VALUE
    reward_of: str = ""  # kind whose learned reward it takes, unchanged


# The environment's reward in the place of the learned one, with hindsight.
HAND_MADE = (
    "learner.learned_weight=0",
    "learner.hand_made_weight=1",
    "learner.expert_share=0",
    "learner.reward_scale=0.1",
    "learner.initial_alpha=0.1",
    "learner.hindsight.reached_share=0.25",
    "learner.hindsight.near_share=0.5",
)
# A learned reward, taken unchanged, with hindsight.
LEARNED = (*HAND_MADE[2:], "learner.learned_weight=5", "learner.hand_made_weight=0")
# Without S2R a pose is off by several millimetres: a sixth of the steps teaches it.
WITHOUT_S2R = ("learner.total_env_steps=524288",)
KINDS = {
    # Open space
    "specified": Kind("specification alone"),
    "without": Kind("calibrated springs"),
    "chambers": Kind("calibrated springs and chambers", settings=WITHOUT_S2R),
    "with": Kind("with S2R"),
    "gradient": Kind("gradient descent"),
    "payload": Kind("with S2R, payload", "payload"),
    "quick": Kind("with S2R, quick", "quick"),
    # Pipes
    "pipe": Kind("learned reward", "pipe", "pipe300"),
    "hand-made": Kind("hand-made reward", "pipe", "pipe300", HAND_MADE),
    "narrow-learned": Kind("learned in the wide pipe", "pipe", "pipe250", LEARNED, reward_of="pipe"),
    "narrow-hand-made": Kind("hand-made reward", "pipe", "pipe250", HAND_MADE),
    "narrowest": Kind("learned reward", "pipe", "pipe200"),
    "narrowest-hand-made": Kind("hand-made reward", "pipe", "pipe200", HAND_MADE),
}
BESIDE = ("payload", "quick")
PIPE_KINDS = tuple(name for name, kind in KINDS.items() if kind.task)


class Trial(NamedTuple):
    """One run on a twin."""

    kind: str  # key of KINDS
    twin: int
    seed: int  # of training
    objects: str = ""  # in the containers of a pipe: key of `trial.OBJECTS_KG`
    load_g: int = 0  # payload, which the loop does not know
    lap_s: float = 0.0  # duration of a lap of the circle without a stop; 0: with stops
    moves: bool = False  # in a pipe, past the positions between the objects without a stop

    @property
    def variant(self) -> str:
        """Objects or payload, and how the arm goes."""
        in_time = f" in {self.lap_s:g} s" if self.lap_s else ""
        return (self.objects or f"{self.load_g} g") + " in motion" * self.moves + in_time

    @property
    def result(self) -> str:
        """File of the figures, in the folder."""
        return f"trials/{self.kind}-twin{self.twin}-seed{self.seed}-{self.variant.replace(' ', '-')}.json"

    @property
    def log(self) -> str:
        """File of the log, in the folder."""
        return self.result.replace(".json", "-log.npz")

    @property
    def logged(self) -> bool:
        """Whether the log is kept, to be drawn over time."""
        return self.kind == "with" and self.load_g in TRACED_G and not self.lap_s


def trials(experiment: str, settings: Settings) -> list[Trial]:
    """Return the trials of "open" or "confined"."""
    listed = []
    if experiment == "confined":
        for run in settings.runs:
            listed += [Trial(kind, *run, "as shown") for kind in PIPE_KINDS]
            listed += [Trial("pipe", *run, "exchanged"), Trial("pipe", *run, "as shown", moves=True)]
        return listed
    loads_g = (0, *settings.loads_g)
    for run in settings.runs:
        listed += [Trial(kind, *run) for kind in ("specified", "without")]
        listed += [Trial("with", *run, load_g=load_g) for load_g in loads_g]
        listed += [Trial("with", *run, lap_s=lap_s) for lap_s in IN_TIME_S]
        listed += [Trial(kind, *run, load_g=load_g) for kind in settings.beside for load_g in loads_g]
    # Without S2R one seed is enough. Gradient descent is not trained, so it runs once for each load.
    for twin in settings.twins:
        listed.append(Trial("chambers", twin, settings.seeds[0]))
        listed += [Trial("gradient", twin, settings.seeds[0], load_g=load_g) for load_g in loads_g]
    return listed


def arm_name(twin: int | None) -> str:
    """Return the name of a twin, or of the nominal arm, in paths."""
    return "nominal" if twin is None else f"twin{twin}"


def demonstrations_path(twin: int, task: str) -> str:
    """Return the path of a twin's demonstrations of a task in the folder."""
    return f"{arm_name(twin)}/demos-{task}.npz"


def run_path(kind: str, twin: int | None, seed: int) -> str:
    """Return the run folder of a kind's policy, or of the one whose arm its solver takes."""
    policy = "with" if kind in ("without", "gradient") else kind
    return f"{policy}-{arm_name(None if kind == 'specified' else twin)}-seed{seed}"
