"""Picking and placing on a twin, and what it gave: errors by motion capture, contact forces, what succeeded.

Whether a thing is taken depends on where the finger tips are as the loop says that it has arrived: near
enough to where the thing lies, the twin gets its weight, else it stays there. A thing let go near enough to a
container's place lies where the finger tips were; else it has fallen beside it, and is lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.paper.measure import Driven, load_arrays, measure, point_of, reached, save_arrays, told
from mjx_softarm.deploy.loop import Controller
from mjx_softarm.deploy.session import follow
from mjx_softarm.mechanics.pipe import APPLE_KG, BALL_KG
from mjx_softarm.sensing.pose import frame_from_pose, rotation_from_quaternion

GRASP_M = 0.02  # finger tips to the thing's middle: the jaws open 40 mm
PLACE_M = 0.04  # finger tips to the middle of a container
CALM_N = 1.0  # contact force that counts as none
# What the containers hold as a task begins: picked first, then picked second.
THINGS_KG = {"as shown": (BALL_KG, APPLE_KG), "exchanged": (APPLE_KG, BALL_KG)}


class Operated(NamedTuple):
    """A run along p positions, of which some are operations; what was not reached is NaN."""

    goal: Any  # (p, 6) [mm, deg]
    error: Any  # (p, 6) [mm, deg] of the tip by motion capture
    saturated: Any  # (p, n) bool
    events: Any  # (faults,) how often the loop told each of `faults.Fault`
    operation: Any  # (p,) bool: a thing is to be taken or let go here
    success: Any  # (p,) bool: and it was; False elsewhere
    name: Any  # (p,) of text
    arrival_s: Any  # (p,)
    time_s: Any  # (ticks,)
    finger_m: Any  # (ticks, 3) finger tips by motion capture
    wall_n: Any  # (ticks,) contact force of the walls, the largest of each tick
    container_n: Any  # (ticks,) and of the containers


class Hands:
    """The gripper of a twin, and what lies in the containers."""

    def __init__(self, arm: Any, names: Sequence[str], goals_m: np.ndarray, objects: str, gripper_m: float):
        """Things lie where the demonstrations have the finger tips, `goals_m` (p, 3), as they take them."""
        self._arm, self._names, self._goals_m, self._gripper_m = arm, names, goals_m, gripper_m
        picks = [k for k, name in enumerate(names) if name.startswith("pick")]
        self._lying = {
            _container(names[k]): (goals_m[k], kg) for k, kg in zip(picks, THINGS_KG[objects], strict=False)
        }
        self._held_kg: float | None = None
        self.success = np.zeros(len(names), bool)

    def arrived(self, k: int) -> None:
        """Take or let go, if that is what position k is for."""
        operation, where = self._names[k].split(" ")[0], _container(self._names[k])
        at_m = self.finger_m()
        if operation == "pick" and self._held_kg is None and where in self._lying:
            place_m, kg = self._lying[where]
            if np.linalg.norm(at_m - place_m) <= GRASP_M:
                del self._lying[where]
                self._held_kg, self.success[k] = kg, True
                self._arm.attach(kg)
        elif operation == "place" and self._held_kg is not None:
            if np.linalg.norm(at_m - self._goals_m[k]) <= PLACE_M:
                self._lying[where], self.success[k] = (at_m, self._held_kg), True
            self._held_kg = None
            self._arm.release()

    def finger_m(self) -> np.ndarray:
        """Where the finger tips (3,) are, by motion capture."""
        seen = self._arm.motion_capture()
        return finger_tips_seen(seen.tip_m, seen.tip_quaternion, self._gripper_m)


def _container(name: str) -> str:
    return name.split(" ")[-1]


def operate(
    arm: Any, controller: Controller, goals: np.ndarray, names: Sequence[str], objects: str
) -> Operated:
    """Go along positions (p, 6) [mm, deg], taking and letting go what their names say."""
    gripper_m = controller.policy.spec.mass.gripper_length_m
    forces: list[tuple[float, float]] = []
    watched = Driven(arm, lambda: forces.append(arm.wall_force_n()))
    hands = Hands(watched, names, finger_tips(goals, gripper_m), objects, gripper_m)
    run = follow(watched, controller, goals, arrived=hands.arrived)
    followed = measure(run, controller, goals)
    log, force_n = run.log, np.zeros((len(run.log), 2))
    force_n[: len(forces)] = forces  # an arm that is lost takes no pressures any more
    assert log.tip_m is not None and log.tip_quaternion is not None  # a twin has motion capture
    arrival_s = np.full(len(goals), np.nan)
    for arrival in run.arrivals:
        arrival_s[point_of(arrival.goal, goals)] = log.time_s[arrival.row]
    return Operated(
        goal=goals,
        error=followed.error,
        saturated=followed.saturated,
        events=followed.events,
        operation=np.array([name.split(" ")[0] in ("pick", "place") for name in names]),
        success=hands.success,
        name=np.array(names),
        arrival_s=arrival_s,
        time_s=log.time_s,
        finger_m=finger_tips_seen(log.tip_m, log.tip_quaternion, gripper_m).astype(np.float32),
        wall_n=force_n[:, 0].astype(np.float32),
        container_n=force_n[:, 1].astype(np.float32),
    )


def finger_tips(pose: np.ndarray, gripper_m: float) -> np.ndarray:
    """Finger tips (..., 3) [m] of poses (..., 6) [mm, deg]."""
    position_m, rotation = frame_from_pose(pose)
    return position_m - gripper_m * rotation[..., 2]


def finger_tips_seen(tip_m: np.ndarray, quaternion: np.ndarray, gripper_m: float) -> np.ndarray:
    """Finger tips (..., 3) [m] of tips (..., 3) [m] and their quaternions (..., 4) by motion capture."""
    return tip_m - gripper_m * rotation_from_quaternion(quaternion)[..., 2]


def save_operated(path: Path, operated: Operated) -> None:
    """Write a result whole or not at all."""
    save_arrays(path, operated._asdict())


def load_operated(path: Path) -> Operated:
    """The result that `save_operated` wrote."""
    return Operated(**load_arrays(path, Operated._fields))


def figures(operated: Operated) -> dict[str, Any]:
    """The figures of one run that stand in tables; errors over the positions that were reached."""
    n_reached, error = reached(operated.error)
    away = np.linalg.norm(error[:, :3], axis=1)
    x, y, z = np.abs(error[:, :3]).mean(axis=0)
    n_operations = int(operated.operation.sum())
    return {
        "positions": len(operated.goal),
        "reached": n_reached,
        "x_mm": float(x),
        "y_mm": float(y),
        "z_mm": float(z),
        "translation_mm": float(away.mean()),
        "max_mm": float(away.max()),
        "operations": n_operations,
        "done": int(operated.success.sum()),
        "all_done": bool(n_operations) and bool(operated.success[operated.operation].all()),
        "saturated_positions": int(np.count_nonzero(operated.saturated.any(axis=1))),
        "calm_percent": 100 * float(np.mean(operated.wall_n < CALM_N)),
        "wall_max_n": float(operated.wall_n.max()),
        "container_max_n": float(operated.container_n.max()),
        "events": told(operated.events),
        "seconds": float(operated.time_s[-1]),
    }
