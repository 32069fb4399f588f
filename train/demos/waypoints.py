"""Tasks as waypoints of the finger tips, one short move after the other.

The paper gives the operations and the number of poses, but no positions. Here the circle is at the height
that the arm reaches best. Waypoints in a pipe are evenly spaced along its axes, from container to container.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjx_softarm.mechanics.excitation import circle_poses
from mjx_softarm.mechanics.pipe import PIPES, CrossPipe
from mjx_softarm.sensing.pose import frame_from_pose
from mjx_softarm.spec import ArmSpec

HOME_BELOW_M = 0.1  # finger tips below the crossing's centre, where the pipe's tasks begin and end

# Orientation of the gripper.
FREE = (0.0, 0.0, 0.0)
STRAIGHT = (1.0, 1.0, 0.0)  # straight down
SQUARE = (1.0, 1.0, 1.0)  # straight down, and its yaw zero


class Waypoint(NamedTuple):
    """A target of the finger tips."""

    name: str  # "pick right", "place left" and the like where an object is taken or let go
    finger_m: np.ndarray  # (3,) in the base frame
    turn: tuple[float, float, float] = FREE  # 1 for each axis of the gripper whose rotation is fixed


# Stops of a path, each with the number of moves to it; the path begins at "home".
_PIPE300 = (("pick right", 4), ("place left", 7), ("pick bottom", 6), ("place right", 6), ("home", 4))
_PIPE250 = (("pick left", 6), ("place bottom", 8), ("pick right", 8), ("place left", 8), ("home", 6))
_STOPS = {"pipe300": _PIPE300, "pipe250": _PIPE250, "pipe200": _PIPE250}
TASKS = ("circle16", *_STOPS)


def task(name: str, spec: ArmSpec) -> tuple[tuple[Waypoint, ...], CrossPipe | None]:
    """Return the waypoints of one of `TASKS` for an arm with the gripper of `spec`, and its pipe."""
    if name == "circle16":
        return circle(16, spec), None
    pipe = PIPES[name]
    return pick_and_place(pipe, _STOPS[name]), pipe


def circle(n: int, spec: ArmSpec) -> tuple[Waypoint, ...]:
    """Return n waypoints on the circle, with the gripper as in the circle's poses."""
    position_m, _ = frame_from_pose(circle_poses(spec, n).astype(float))
    finger_m = position_m - [0.0, 0.0, spec.mass.gripper_length_m]
    return tuple(Waypoint(f"circle {k}", point, SQUARE) for k, point in enumerate(finger_m))


def pick_and_place(pipe: CrossPipe, stops: Sequence[tuple[str, int]]) -> tuple[Waypoint, ...]:
    """Return waypoints from home through the crossing to each stop, in moves of equal length.

    Stops are names, whose last word is a container or "home", and numbers of moves.
    """
    places = dict(pipe.containers())
    crossing = np.array([0.0, 0.0, places["right"][2]])
    places["home"] = np.array([0.0, 0.0, pipe.centre_z_m - HOME_BELOW_M])
    waypoints = [Waypoint("home", places["home"], STRAIGHT)]
    for name, n_moves in stops:
        goal = places[name.split(" ")[-1]]
        way = _along(np.stack([waypoints[-1].finger_m, crossing, goal]), n_moves)
        waypoints += [Waypoint(f"to {name} {k + 1}", point) for k, point in enumerate(way[:-1])]
        waypoints.append(Waypoint(name, goal, STRAIGHT if name == "home" else FREE))
    return tuple(waypoints)


def _along(corner_m: np.ndarray, n: int) -> np.ndarray:
    """Return points (n, 3) evenly spaced along a path with corners (k, 3), without its first point."""
    length_m = np.linalg.norm(np.diff(corner_m, axis=0), axis=1)
    distance_m = np.concatenate([[0.0], np.cumsum(length_m)])
    stop_m = distance_m[-1] * np.arange(1, n + 1) / n
    return np.stack([np.interp(stop_m, distance_m, corner_m[:, k]) for k in range(3)], axis=-1)
