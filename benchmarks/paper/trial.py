"""A trial on a twin and its outcome: errors by motion capture, saturation, contact forces, objects moved.

An object is taken if the finger tips are near it when the loop reports an arrival: the twin then gets its
weight. The padded floor of a container carries more of it the lower the object is, and all where the object
is picked or placed. An object that is released near its container lies where the finger tips were; elsewhere
it is lost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.paper.trials import Trial
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy import measure as accuracy
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.safety import Fault
from mjx_softarm.deploy.session import LoopRun, follow, trace
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.pipe import APPLE_KG, BALL_KG
from mjx_softarm.sensing.pose import frame_from_pose

GRASP_M = 0.02  # finger tips to the object's middle: the jaws open 40 mm
PLACE_M = 0.04  # finger tips to the middle of a container
PADDING_KG_PER_M = APPLE_KG / 0.01  # weight that a container's floor carries: an apple sinks in 10 mm
PACE_S = 1.0  # from a position to the next, where the arm does not stop
CALM_N = 1.0  # contact force that counts as none
WAY = ("way_mm", "way_95_mm", "way_max_mm", "lag_s", "way_without_lag_mm")  # figures of `accuracy.along`
# Masses in the containers when a task begins: the one picked first, then the one picked second.
OBJECTS_KG = {"as shown": (BALL_KG, APPLE_KG), "exchanged": (APPLE_KG, BALL_KG)}


class TrialOutcome(NamedTuple):
    """Outcome of a trial with p goals and t ticks, on an arm with n chambers; NaN where a goal was missed."""

    goal: np.ndarray  # (p, 6) [mm, deg]
    name: np.ndarray  # (p,) text, such as "pick left"
    error: np.ndarray  # (p, 6) [mm, deg] of the tip by motion capture
    believed: np.ndarray  # (p, 6) [mm, deg] pose that the loop estimated, less the goal
    saturated: np.ndarray  # (p, n) bool: chamber at a limit with its spring off the reference, on arrival
    success: np.ndarray  # (p,) bool: an object was picked or placed
    arrival_s: np.ndarray  # (p,)
    load_estimate_g: np.ndarray  # (p,) payload that the loop believed in, on arrival
    events: np.ndarray  # (faults,) how often the loop reported each of `Fault`
    time_s: np.ndarray  # (t,)
    wall_n: np.ndarray  # (t,) contact force of the walls, the largest within each tick
    way: np.ndarray  # (len(WAY),) distances from a goal that moves, NaN where goals stand still

    @property
    def operation(self) -> np.ndarray:
        """Mask (p,) of the goals at which an object is to be picked or placed."""
        return np.char.startswith(self.name, "pick") | np.char.startswith(self.name, "place")


class WatchedTwin:
    """A twin that calls a function each time it has been driven; all else is the twin's own."""

    def __init__(self, twin: Any, on_driven: Callable[[], None]):
        self._twin, self._on_driven = twin, on_driven

    def __getattr__(self, name: str) -> Any:
        return getattr(self._twin, name)

    def write_pressures(self, pressure_kpa: np.ndarray) -> None:
        """Drive the twin; see `ArmIO`."""
        self._twin.write_pressures(pressure_kpa)
        self._on_driven()


class Gripper:
    """The gripper of a twin, and the objects in the containers.

    An object lies where the demonstrated finger tips pick it, in `goals_m` (p, 3).
    """

    def __init__(self, arm: Any, names: Sequence[str], goals_m: np.ndarray, objects: str, gripper_m: float):
        self._arm, self._names, self._goals_m, self._gripper_m = arm, names, goals_m, gripper_m
        picks = [k for k, name in enumerate(names) if name.startswith("pick")]
        masses_kg = OBJECTS_KG.get(objects, ())
        self._lying = {
            _container(names[k]): (goals_m[k], kg) for k, kg in zip(picks, masses_kg, strict=False)
        }
        self._held_kg: float | None = None
        self._hung_kg = 0.0  # mass of the held object that no floor carries
        self._floors_m = np.array(
            [goals_m[k] for k, name in enumerate(names) if name.startswith(("pick", "place"))]
        )
        self.success = np.zeros(len(names), bool)

    def driven(self) -> None:
        """Hang that part of the held object's weight to the arm that no container's floor carries."""
        if self._held_kg is None:
            return
        off_m = self.finger_m() - self._floors_m
        near = np.linalg.norm(off_m[:, :2], axis=1) <= PLACE_M
        above_m = off_m[near, 2].min(initial=np.inf)
        hung_kg = float(np.clip(PADDING_KG_PER_M * above_m, 0.0, self._held_kg))
        if hung_kg != self._hung_kg:
            self._hung_kg = hung_kg
            self._arm.attach(hung_kg)

    def arrived(self, k: int) -> None:
        """Pick or place at goal k, if its name says so."""
        operation, container = self._names[k].split(" ")[0], _container(self._names[k])
        if operation == "pick" and self._held_kg is None and container in self._lying:
            object_m, kg = self._lying[container]
            if np.linalg.norm(self.finger_m() - object_m) <= GRASP_M:
                del self._lying[container]
                self._held_kg, self.success[k] = kg, True
                self.driven()
        elif operation == "place" and self._held_kg is not None:
            finger_m = self.finger_m()
            if np.linalg.norm(finger_m - self._goals_m[k]) <= PLACE_M:
                self._lying[container], self.success[k] = (finger_m, self._held_kg), True
            self._held_kg, self._hung_kg = None, 0.0
            self._arm.release()

    def finger_m(self) -> np.ndarray:
        """Return the true place of the finger tips (3,) [m]."""
        tip_m, rotation = self._arm.tip()
        return below_tips(tip_m, rotation, self._gripper_m)


def _container(name: str) -> str:
    return name.split(" ")[-1]


def finger_tips(pose: np.ndarray, gripper_m: float) -> np.ndarray:
    """Return the finger tips (..., 3) [m] of poses (..., 6) [mm, deg]."""
    return below_tips(*frame_from_pose(pose), gripper_m)


def below_tips(tip_m: np.ndarray, rotation: np.ndarray, gripper_m: float) -> np.ndarray:
    """Return the finger tips (..., 3) [m] of tips (..., 3) [m] with rotations (..., 3, 3)."""
    return tip_m - gripper_m * rotation[..., 2]


def operate(
    twin: Any, controller: Controller, goals: np.ndarray, names: Sequence[str], trial: Trial
) -> tuple[TrialOutcome, Log]:
    """Follow goals (p, 6) [mm, deg], picking and placing as their names say; return outcome and log.

    On a lap in time only the first and the last goal are stops; in motion, all but those named "to ...". The
    outcome has the stops alone.

    Raises:
        InputError: no tick was logged.
    """
    # Watch the twin's contact forces and its gripper.
    gripper_m = controller.policy.spec.mass.gripper_length_m
    forces_n: list[float] = []
    force = getattr(twin, "wall_force_n", lambda: (0.0, 0.0))  # a rod touches nothing
    gripper = Gripper(twin, names, finger_tips(goals, gripper_m), trial.objects, gripper_m)

    def driven() -> None:
        """Note the wall's force of a control period, and let a floor carry what is held."""
        forces_n.append(force()[0])
        gripper.driven()

    watched: Any = WatchedTwin(twin, driven)
    # Run the loop, with or without stops.
    passed = np.char.startswith(names, "to ") & trial.moves | bool(trial.lap_s)
    passed[[0, -1]] = False
    stops = np.flatnonzero(~passed)
    if trial.moves or trial.lap_s:
        pace_s = trial.lap_s / (len(goals) - 1) if trial.lap_s else PACE_S
        run = trace(watched, controller, goals, pace_s, ~passed, arrived=gripper.arrived)
        arrivals = (a._replace(index=int(np.searchsorted(stops, a.index))) for a in run.arrivals)
        run = run._replace(arrivals=tuple(arrivals))
    else:
        run = follow(watched, controller, goals, arrived=gripper.arrived)
    # Measure the run.
    outcome = measure(run, controller, goals[stops])
    if trial.lap_s and run.ways:
        along = accuracy.along(accuracy.ways_of(run), controller.dt_s)
        outcome = outcome._replace(way=np.array([along[name] for name in WAY]))
    # Add the objects and the forces of each tick.
    wall_n = np.zeros(len(run.log), np.float32)
    n = min(len(forces_n), len(wall_n))  # a lost arm takes no more pressures; venting is not logged
    wall_n[:n] = forces_n[:n]
    success = gripper.success[stops]
    return outcome._replace(name=np.array(names)[stops], success=success, wall_n=wall_n), run.log


def measure(run: LoopRun, controller: Controller, goals: np.ndarray) -> TrialOutcome:
    """Return the outcome of a run towards goals (p, 6) [mm, deg], without objects and contact forces.

    Raises:
        InputError: no tick was logged.
    """
    log = run.log
    if not len(log):
        cause = run.ending.cause or "all were refused"
        raise InputError(f"goals: got {len(goals)} and no tick of the loop: {cause}, expected one to go to")
    counts = run.counts()
    return TrialOutcome(
        **accuracy.measure(run, controller, goals)._asdict(),
        name=np.full(len(goals), ""),
        success=np.zeros(len(goals), bool),
        events=np.array([counts.get(fault, 0) for fault in Fault]),
        time_s=log.time_s,
        wall_n=np.zeros(len(log), np.float32),
        way=np.full(len(WAY), np.nan),
    )


def figures(outcome: TrialOutcome) -> dict[str, Any]:
    """Return the figures of one trial; errors over the goals that were measured, NaN without any."""
    errors = accuracy.Accuracy(*(getattr(outcome, name) for name in accuracy.Accuracy._fields))
    return {
        **accuracy.figures(errors, dict(zip(Fault, outcome.events, strict=True))),
        **dict(zip(WAY, outcome.way.tolist(), strict=True)),
        "operations": int(outcome.operation.sum()),
        "done": int(outcome.success.sum()),
        "calm_percent": 100 * float(np.mean(outcome.wall_n < CALM_N)),
        "wall_max_n": float(outcome.wall_n.max()),
        "seconds": float(outcome.time_s[-1]),
    }
