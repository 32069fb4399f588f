"""Parts that the paper's experiments compare: settings, ways to find references, and trials of them on twins.

All stages share the folder of a benchmark, so that the same command goes on where it ended:

    twinT/log.npz, twinT/calibration/      recorded and calibrated through `ArmIO` and logs alone
    twinT/demos-TASK.npz                   demonstrations of the scripted expert on the twin
    nominal-seedS/, twinT-seedS/           policies `analytic`; the nominal ones know no twin
    KIND-twinT-seedS/                      policies of other kinds; see `KINDS`
    trials/TRIAL.npz, trials/TRIAL-log.npz outcome of a trial on a twin, and the log of some
    independence/KIND-seedS.json           errors with payloads, see `benchmarks.paper.independence`
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

EXPERIMENTS = ("open", "confined", "independence")
CALIBRATION, EVALUATION_FILE, POLICY_FILE = "calibration", "evaluation.json", "policy.npz"
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
    preset: str = ""  # of `python -m train reach`, or of `imitate` where there is a task
    task: str = ""  # key of `mjx_softarm.mechanics.pipe.PIPES`, whose demonstrations it learns from
    settings: tuple[str, ...] = ()  # NAME=VALUE
    reward_of: str = ""  # kind whose learned reward it takes, unchanged


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
LEARNED = (*BOTH, "learner.hand_made_weight=0")
# Without S2R a pose is off by several millimetres: a sixth of the steps teaches it.
WITHOUT_S2R = ("learner.total_env_steps=524288",)
KINDS = {
    # Open space
    "specified": Kind("specification alone"),
    "without": Kind("calibrated springs"),
    "chambers": Kind("calibrated springs and chambers", "analytic", settings=WITHOUT_S2R),
    "with": Kind("with S2R"),
    "gradient": Kind("gradient descent"),
    "payload": Kind("with S2R, payload", "payload"),
    "quick": Kind("with S2R, quick", "quick"),
    "motion": Kind("with S2R, motion", "motion"),
    # Pipes
    "pipe": Kind("learned reward", "pipe", "pipe300"),
    "hand-made": Kind("hand-made reward", "pipe", "pipe300", HAND_MADE),
    "narrow": Kind("hand-made, and learned in the wide pipe", "pipe", "pipe250", BOTH, reward_of="pipe"),
    "narrow-learned": Kind("learned in the wide pipe", "pipe", "pipe250", LEARNED, reward_of="pipe"),
    "narrow-hand-made": Kind("hand-made reward", "pipe", "pipe250", HAND_MADE),
    "narrowest": Kind("learned reward", "pipe", "pipe200"),
    "narrowest-hand-made": Kind("hand-made reward", "pipe", "pipe200", HAND_MADE),
}
BESIDE = ("payload", "quick", "motion")
PIPE_KINDS = tuple(name for name, kind in KINDS.items() if kind.task)

PolicyKey = tuple[str, int, int]  # kind, twin, seed


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
        """File of the outcome, in the folder."""
        return f"trials/{self.kind}-twin{self.twin}-seed{self.seed}-{self.variant.replace(' ', '-')}.npz"

    @property
    def log(self) -> str:
        """File of the log, in the folder."""
        return self.result.replace(".npz", "-log.npz")


def trials(experiment: str, settings: Settings) -> list[Trial]:
    """Return the trials of an experiment."""
    makers = {"open": _open_trials, "confined": _confined_trials}
    return makers[experiment](settings) if experiment in makers else []


def _open_trials(settings: Settings) -> list[Trial]:
    loads_g, listed = (0, *settings.loads_g), []
    for twin, seed in arms_and_seeds(settings):
        listed += [Trial(kind, twin, seed) for kind in ("specified", "without")]
        for kind in ("with", *settings.beside):
            moving = kind.startswith("motion")
            listed += [Trial(kind, twin, seed, load_g=load_g) for load_g in ((0,) if moving else loads_g)]
            if moving or kind == "with":
                listed += [Trial(kind, twin, seed, lap_s=lap_s) for lap_s in IN_TIME_S]
    # Without S2R one seed is enough. Gradient descent is not trained, so it runs once for each load.
    first = settings.seeds[0]
    for twin in settings.twins:
        listed.append(Trial("chambers", twin, first))
        listed += [Trial("gradient", twin, first, load_g=load_g) for load_g in loads_g]
    return listed


def _confined_trials(settings: Settings) -> list[Trial]:
    listed = [Trial(*key, "as shown") for key in pipe_policies(settings)]
    for twin, seed in arms_and_seeds(settings):
        listed.append(Trial("pipe", twin, seed, "exchanged"))
        listed.append(Trial("pipe", twin, seed, "as shown", moves=True))
    return listed


def traced(settings: Settings) -> list[Trial]:
    """Return the trials whose logs are kept and drawn."""
    first = Trial("with", settings.twins[0], settings.seeds[0])
    return [first._replace(load_g=load_g) for load_g in TRACED_G if load_g in (0, *settings.loads_g)]


def filmed(experiment: str, settings: Settings) -> Trial:
    """Return the trial that is filmed."""
    first = settings.twins[0], settings.seeds[0]
    return Trial("with", *first) if experiment == "open" else Trial("pipe", *first, "as shown")


def pipe_policies(settings: Settings) -> list[PolicyKey]:
    """Return all policies that are learned from demonstrations."""
    return [(kind, *run) for kind in PIPE_KINDS for run in arms_and_seeds(settings)]


def arms_and_seeds(settings: Settings) -> list[tuple[int, int]]:
    """Return all pairs of a twin and a training seed."""
    return [(twin, seed) for twin in settings.twins for seed in settings.seeds]


def arm_name(twin: int | None) -> str:
    """Return the name of a twin, or of the nominal arm, in paths."""
    return "nominal" if twin is None else f"twin{twin}"


def s2r_path(twin: int) -> str:
    """Return the path of the errors of an arm's sim-to-real networks in the folder."""
    return f"{arm_name(twin)}/s2r.json"


def demonstrations_path(twin: int, task: str) -> str:
    """Return the path of a twin's demonstrations of a task in the folder."""
    return f"twin{twin}/demos-{task}.npz"


def run_path(kind: str, twin: int | None, seed: int) -> str:
    """Return the run folder of a kind's policy, or of the one whose arm its solver takes.

    The runs of "with" and, on the nominal arm, of "specified" have no kind in their names.
    """
    arm = arm_name(None if kind == "specified" else twin)
    own = "" if kind in ("specified", "without", "with", "gradient") else f"{kind}-"
    return f"{own}{arm}-seed{seed}"
