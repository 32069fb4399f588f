"""The experiments as data: ways to find references, trials on twins, and the stages of each experiment.

The folder of a benchmark, which both experiments share:

    twinT/log.npz, twinT/calibration/      recorded and calibrated through `ArmIO` and logs alone
    twinT/comparison.npz                   the first twin beside its simulation, before and after calibration
    twinT/demos-TASK.npz                   demonstrations of the scripted expert on the twin
    nominal-seedS/, twinT-seedS/           policies without demonstrations; the nominal ones know no twin
    KIND-twinT-seedS/                      policies without S2R, of other presets, or learned from
                                           demonstrations; see `KINDS`
    trials/TRIAL.npz                       what a trial on a twin measured
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from benchmarks.paper import jobs
from benchmarks.paper.engine import Settings, Stage
from benchmarks.paper.kinds import (
    EVALUATION_FILE,
    KINDS,
    POLICY_FILE,
    TASKS,
    Trial,
    arm_name,
    learned_run,
    reach_run,
)

FILMS = {"open": "circle.gif", "confined": "pipe.gif"}
FILMED_LOADS_G = (500, 1000)  # in open space, beside the unloaded arm


def trainings(settings: Settings) -> list[tuple[str, int, int]]:
    """Return all (kind, twin, seed) learned from demonstrations; without penalty on the first twin alone."""
    learned = [kind for kind in KINDS if KINDS[kind].task]
    found = [(kind, twin, seed) for kind in learned for twin in settings.twins for seed in settings.seeds]
    return [item for item in found if item[0] != "no-penalty" or item[1] == settings.twins[0]]


def trials(experiment: str, settings: Settings) -> list[Trial]:
    """Return the trials of an experiment, a key of `FILMS`.

    In open space, gradient descent has no training seed, so it runs once for each twin and load. In confined
    spaces the policy without gradient penalty is judged by its training alone, and the circle without
    demonstrations is a trial of the policy that those with them begin with. In motion both are tried, the
    policy learned at rest and that learned in motion, and the latter is judged.
    """
    found = []
    if experiment == "open":
        for twin in settings.twins:
            loads_g = (0, *settings.loads_g)
            for seed in settings.seeds:
                found += [Trial(kind, twin, seed) for kind in ("specified", "without", "chambers")]
                told = ("with", *settings.beside)
                found += [Trial(kind, twin, seed, load_g=load_g) for kind in told for load_g in loads_g]
            found += [Trial("gradient", twin, settings.seeds[0], load_g=load_g) for load_g in loads_g]
        return found
    for kind, twin, seed in trainings(settings):
        if kind not in ("no-penalty", "moving"):
            found.append(Trial(kind, twin, seed, "as shown"))
        if kind == "pipe":
            found.append(Trial(kind, twin, seed, "exchanged"))
        if kind in ("pipe", "moving"):
            found.append(Trial(kind, twin, seed, "as shown", moves=True))
    return found + [Trial("quick", twin, seed) for twin in settings.twins for seed in settings.seeds]


def stages(experiment: str, settings: Settings) -> list[list[Stage]]:
    """Return the stages of an experiment, group by group."""
    calibrations = [
        Stage(f"log and calibrate twin {t}", (f"twin{t}/{jobs.CALIBRATION}",), jobs.calibrate_twin, (t,))
        for t in settings.twins
    ]
    runs = [(twin, seed) for twin in settings.twins for seed in settings.seeds]
    tried = [
        Stage(f"try {trial.name}", (trial.result,), jobs.try_out, (trial,))
        for trial in trials(experiment, settings)
    ]
    kind, objects = ("with", "") if experiment == "open" else ("pipe", "as shown")
    filmed = Trial(kind, settings.twins[0], settings.seeds[0], objects)
    film = Stage("film", (FILMS[experiment],), jobs.film, ((filmed,), FILMS[experiment]))
    films = [film] * (settings.arm == "twin")  # a rod cannot be drawn
    if experiment == "open":
        nominal = [_reach(None, seed) for seed in settings.seeds]
        others = [(kind, *run) for kind in ("chambers", *settings.beside) for run in runs]
        on_twins = [_reach(*run) for run in runs] + [_learn(*item, jobs.train_other) for item in others]
        exports = [_export(twin, others, settings.seeds) for twin in (None, *settings.twins)]
        loads = _film_loads(filmed, settings) * (settings.arm == "twin")
        compared = _compare(settings.twins[0])
        return [[*calibrations, *nominal], [*on_twins, compared], exports, [*tried, *films, *loads]]
    path = jobs.demonstrations_path
    demonstrations = [
        Stage(f"demonstrate {task} on twin {twin}", (path(twin, task),), jobs.demonstrate, (twin, task))
        for task in TASKS
        for twin in settings.twins
    ]
    quick = [("quick", *run) for run in runs]
    on_twins = [_learn(*item, jobs.train_other) for item in quick]
    first = [_learn(*item) for item in trainings(settings) if not KINDS[item[0]].reward_of]
    with_their_reward = [_learn(*item) for item in trainings(settings) if KINDS[item[0]].reward_of]
    exports = [_export(twin, [*quick, *trainings(settings)]) for twin in settings.twins]
    return [calibrations, [*demonstrations, *on_twins], first, with_their_reward, exports, [*tried, *films]]


def _compare(twin: int) -> Stage:
    result = f"twin{twin}/{jobs.COMPARISON_FILE}"
    return Stage(f"compare twin {twin} with its simulation", (result,), jobs.compare_twin, (twin,))


def _film_loads(unloaded: Trial, settings: Settings) -> list[Stage]:
    """Return the stage that films a trial beside the same with loads, if the experiment has such loads."""
    loads_g, file = _filmed_loads_g(settings), loads_film(settings)
    shown = (unloaded, *(unloaded._replace(load_g=load_g) for load_g in loads_g))
    stage = Stage("film of loads", (file,), jobs.film, (shown, file))
    return [stage] * bool(loads_g)


def loads_film(settings: Settings) -> str:
    """Return the name of the film of loads in the folder; it names them, since loads may be added."""
    return "-".join(["loads", *map(str, _filmed_loads_g(settings))]) + ".gif"


def _filmed_loads_g(settings: Settings) -> list[int]:
    return [load_g for load_g in settings.loads_g if load_g in FILMED_LOADS_G]


def _reach(twin: int | None, seed: int) -> Stage:
    name = f"train {'nominal arm' if twin is None else f'for twin {twin}'}, seed {seed}"
    return Stage(name, (f"{reach_run(twin, seed)}/{EVALUATION_FILE}",), jobs.train_reach, (twin, seed))


def _learn(kind: str, twin: int, seed: int, job: Callable[..., None] = jobs.learn) -> Stage:
    result = f"{learned_run(kind, twin, seed)}/{EVALUATION_FILE}"
    return Stage(f"learn {kind} for twin {twin}, seed {seed}", (result,), job, (kind, twin, seed))


def _export(twin: int | None, learned: Iterable[tuple[str, int, int]], seeds: Iterable[int] = ()) -> Stage:
    """Return the stage that exports an arm's policies of other kinds, and the experiment's own of `seeds`."""
    mine = [item for item in learned if item[0] != "no-penalty" and item[1] == twin]
    runs = (*(reach_run(twin, seed) for seed in seeds), *(learned_run(*item) for item in mine))
    policies = tuple(f"{run}/{POLICY_FILE}" for run in runs)
    return Stage(f"export for {arm_name(twin)}", policies, jobs.export, (twin, runs))
