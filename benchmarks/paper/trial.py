"""A trial on a twin and its figures: errors by motion capture, saturation, contact forces, objects moved.

A held object hangs at the twin, less what a container's padded floor carries: all of it where the object is
picked or placed. One that is released far from a container is lost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.paper.trials import Trial
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy import measure as accuracy
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.session import LoopRun, follow, trace
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.pipe import APPLE_KG, BALL_KG
from mjx_softarm.sensing.pose import frame_from_pose

GRASP_M = 0.02  # finger tips to the object's middle: the jaws open 40 mm
PLACE_M = 0.04  # finger tips to the middle of a container
PADDING_KG_PER_M = APPLE_KG / 0.01  # weight that a container's floor carries: an apple sinks in 10 mm
PACE_S = 1.0  # from a position to the next, where the arm does not stop
CALM_N = 1.0  # contact force that counts as none
# Masses in the containers when a task begins: the one picked first, then the one picked second.
OBJECTS_KG = {"as shown": (BALL_KG, APPLE_KG), "exchanged": (APPLE_KG, BALL_KG)}


def watch(twin: Any, on_driven: Callable[[], None]) -> None:
    """Let a twin call a function each time that it has been driven."""
    drive = twin.write_pressures

    def write_pressures(pressure_kpa: np.ndarray) -> None:
        drive(pressure_kpa)
        on_driven()

    twin.write_pressures = write_pressures


class Gripper:
    """The gripper of a twin, and the objects in the containers.

    An object lies where the demonstrated finger tips pick it, in `goals_m` (p, 3).
    """

    def __init__(self, arm: Any, names: Sequence[str], goals_m: np.ndarray, objects: str, gripper_m: float):
        self._arm, self._goals_m, self._gripper_m = arm, goals_m, gripper_m
        self._operations = [(*name.split(" "), "")[0] for name in names]
        self._containers = [name.split(" ")[-1] for name in names]
        picks = [k for k, operation in enumerate(self._operations) if operation == "pick"]
        masses_kg = OBJECTS_KG.get(objects, ())
        self._lying = {self._containers[k]: (goals_m[k], kg) for k, kg in zip(picks, masses_kg, strict=False)}
        self._held_kg: float | None = None
        self._hung_kg = 0.0  # mass of the held object that no floor carries
        self.operates = np.isin(self._operations, ["pick", "place"])  # (p,) bool
        self.success = np.zeros(len(names), bool)  # (p,) an object was picked or placed

    def hang(self) -> None:
        """Hang that part of the held object's weight to the arm that no container's floor carries."""
        if self._held_kg is None:
            return
        off_m = self._finger_m() - self._goals_m[self.operates]
        near = np.linalg.norm(off_m[:, :2], axis=1) <= PLACE_M
        above_m = off_m[near, 2].min(initial=np.inf)
        hung_kg = float(np.clip(PADDING_KG_PER_M * above_m, 0.0, self._held_kg))
        if hung_kg != self._hung_kg:
            self._hung_kg = hung_kg
            self._arm.attach(hung_kg)

    def operate(self, k: int) -> None:
        """Pick or place at goal k, if its name says so; a rod has no gripper to ask for its place."""
        if not self.operates[k]:
            return
        operation, container, finger_m = self._operations[k], self._containers[k], self._finger_m()
        if operation == "pick" and self._held_kg is None and container in self._lying:
            object_m, kg = self._lying[container]
            if np.linalg.norm(finger_m - object_m) <= GRASP_M:
                del self._lying[container]
                self._held_kg, self.success[k] = kg, True
                self.hang()
        elif operation == "place" and self._held_kg is not None:
            if np.linalg.norm(finger_m - self._goals_m[k]) <= PLACE_M:
                self._lying[container], self.success[k] = (finger_m, self._held_kg), True
            self._held_kg, self._hung_kg = None, 0.0
            self._arm.attach(0.0)

    def _finger_m(self) -> np.ndarray:
        """Return the true place of the finger tips (3,) [m]."""
        tip_m, rotation = self._arm.tip()
        return finger_tips(tip_m, rotation, self._gripper_m)


def finger_tips(tip_m: np.ndarray, rotation: np.ndarray, gripper_m: float) -> np.ndarray:
    """Return the finger tips (..., 3) [m] below tips (..., 3) [m] with rotations (..., 3, 3)."""
    return tip_m - gripper_m * rotation[..., 2]


def operate(
    twin: Any, controller: Controller, goals: np.ndarray, names: Sequence[str], trial: Trial
) -> tuple[dict[str, Any], Log]:
    """Follow goals (p, 6) [mm, deg], picking and placing as their names say; return figures and log.

    On a lap in time only the first and the last goal are stops; in motion, all but those named "to ...". The
    figures are of the stops alone.
    """
    # Watch the twin's contact forces and its gripper.
    gripper_m = controller.policy.spec.mass.gripper_length_m
    forces_n: list[float] = []
    gripper = Gripper(twin, names, finger_tips(*frame_from_pose(goals), gripper_m), trial.objects, gripper_m)

    def note() -> None:
        """Note the wall's force of a control period, and let a floor carry what is held."""
        forces_n.append(getattr(twin, "wall_force_n", 0.0))  # a rod touches nothing
        gripper.hang()

    watch(twin, note)
    # Run the loop, with or without stops.
    passed = (np.char.startswith(names, "to ") & trial.moves) | bool(trial.lap_s)
    passed[[0, -1]] = False
    stops = np.flatnonzero(~passed)
    if trial.moves or trial.lap_s:
        pace_s = trial.lap_s / (len(goals) - 1) if trial.lap_s else PACE_S
        run = trace(twin, controller, goals, pace_s, ~passed, arrived=gripper.operate)
        arrivals = (a._replace(index=int(np.searchsorted(stops, a.index))) for a in run.arrivals)
        run = run._replace(arrivals=tuple(arrivals))
    else:
        run = follow(twin, controller, goals, arrived=gripper.operate)
    if not len(run.log):
        cause = run.ending.cause or "all were refused"
        raise InputError(f"goals: got {len(goals)} and no tick of the loop: {cause}, expected one to go to")
    # A lost arm takes no more pressures; venting is not logged.
    done = gripper.operates[stops], gripper.success[stops]
    wall_n = np.array(forces_n[: len(run.log)])
    return figures(run, controller, goals[stops], trial) | force_figures(wall_n, *done), run.log


def figures(run: LoopRun, controller: Controller, goals: np.ndarray, trial: Trial) -> dict[str, Any]:
    """Return figures of a run towards goals (p, 6) [mm, deg]; NaN where no goal was measured."""
    errors = accuracy.measure(run, controller, goals)
    numbers = accuracy.figures(errors, run.counts())
    if trial.lap_s and run.ways:
        numbers |= accuracy.along(accuracy.ways_of(run), controller.dt_s)
    seen_g = 1e3 * errors.load_kg[np.isfinite(errors.load_kg)]
    off_g = float(np.abs(seen_g - trial.load_g).mean()) if len(seen_g) and not trial.objects else np.nan
    at_stops = {name: getattr(errors, name).tolist() for name in ("goal", "error", "saturated")}
    return {**numbers, "load_off_g": off_g, "seconds": float(run.log.time_s[-1]), "at_stops": at_stops}


def force_figures(wall_n: np.ndarray, operates: np.ndarray, success: np.ndarray) -> dict[str, Any]:
    """Return figures of the wall's largest force in each tick (t,) [N], and of operations done (p,)."""
    return {
        "operations": int(operates.sum()),
        "done": int(success.sum()),
        "calm_percent": 100 * float(np.mean(wall_n < CALM_N)),
        "wall_max_n": float(wall_n.max()),
    }
