"""The loop's side of the live view: a page steers the arm and shows each tick.

The page's server is a separate process, so that no browser takes time from the loop: a tick puts its numbers
into a channel and takes the orders from it.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_softarm._support.errors import InputError
from mjx_softarm.control import saturated
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.drivers.names import Paced
from mjx_softarm.deploy.ending import FAULT
from mjx_softarm.deploy.goals import Order
from mjx_softarm.deploy.link import Recorder
from mjx_softarm.deploy.loop import LoopState
from mjx_softarm.deploy.session import LoopRun, steer
from mjx_softarm.deploy.strategy import AtRest, Timed
from mjx_softarm.logs.schema import Log
from mjx_softarm.mechanics.excitation import circle_poses
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.lag import still
from mjx_softarm.policy.reach import clamped
from mjx_softarm.sensing.pose import pose_error, pose_from_quaternion, quaternion_from_pose
from mjx_softarm.spec import ArmSpec
from mjx_softarm.view.channel import ChannelEnd
from mjx_softarm.view.look import look_at

if TYPE_CHECKING:
    from mjx_softarm.view.page import Setup

LOCAL = ("127.0.0.1", "localhost")  # hosts that other machines do not reach
READY_S = 60.0  # for the server to start
N_LINES = 4  # number of the loop's last messages on the page
APART = np.repeat([1.0, 1.0], 3)  # [mm, deg] smallest difference from the last taken pose, in one number
_ROUNDS = 100  # rounds of the circle, and of picking and placing
_LIFT_MM, _OBJECT_KG = 25.0, 0.22  # height of a lift; mass of an apple, as in the paper's pipe


class TakenPoses:
    """Demonstrations for `train imitate`: poses of one sequence, each checked as it is taken."""

    def __init__(self, policy: Policy):
        self._policy, self._rows = policy, Recorder()
        self._last = np.full(6, np.inf)

    def __len__(self) -> int:
        return len(self._rows)

    def take(self, state: LoopState, row: Mapping[str, Any]) -> str:
        """Keep the pose of a tick if training can use it; return a message.

        Without motion capture, the estimate of the tick's row is the pose.
        """
        seen = np.isfinite(row.get("tip_quaternion", np.nan)).all()
        pose = pose_from_quaternion(row["tip_m"], row["tip_quaternion"]) if seen else row["estimate"]
        refused = self._refused(state, row["readings"], np.asarray(pose, float))
        if refused:
            return f"pose not taken: {refused}"
        tip = {"tip_m": 1e-3 * pose[:3], "tip_quaternion": quaternion_from_pose(pose)}
        self._rows.add({"time_s": row["time_s"], "readings": row["readings"], "sequence": 0} | tip)
        self._last = pose
        place = ", ".join(f"{value:.0f}" for value in pose[:3])
        return f"pose {len(self)} taken: tip at {place} mm, {'measured' if seen else 'estimated'}"

    def log(self) -> Log:
        """Return the poses as a log."""
        return self._rows.log("demonstrations", self._policy.sensor)

    def _refused(self, state: LoopState, readings: np.ndarray, pose: np.ndarray) -> str:
        """Return the reason to refuse a pose, or an empty text."""
        # The arm must be at rest, with all readings, no chamber saturated.
        policy, belief, command = self._policy, state.belief, state.command
        low, high = np.sort(policy.actions[1:], axis=0)
        if command.reference_m is None or state.goal is not None or not still(belief.window_m):
            return "got an arm that moves or has no pressure, expected one at rest"
        if belief.lost.any() or not np.isfinite(pose).all():
            return f"spring {np.argmax(belief.lost)}: got no reading, expected one"
        held = command.pressure_kpa, command.reference_m, belief.spring_m
        mask = saturated(*held, policy.gains, policy.tolerance_m)
        if mask.any():
            return f"chamber {np.argmax(mask)}: got its limit of pressure, its spring off the reference"
        # The pose must be an action, and a new one.
        outside = (readings < low) | (readings > high)
        if outside.any():
            k = int(np.argmax(outside))
            got = f"spring {k}: got {readings[k]:.6g} {policy.sensor.unit}"
            return f"{got}, expected {low[k]:.6g} to {high[k]:.6g}, the range of actions"
        with np.errstate(invalid="ignore"):
            if (np.abs(pose_error(pose, self._last)) < APART).all():
                return "got the pose that was taken last, expected another"
        return ""


class PagePilot:
    """Orders from a page.

    After Stop or Vent, goals are ignored until a user asks for motion again. So a page that keeps sending
    goals cannot undo a stop.
    """

    def __init__(self, end: ChannelEnd, arm: Any, controller: Controller, tell: Callable[[str], None]):
        self._end, self._arm, self._controller = end, arm, controller
        self._tell, self._said = tell, deque(maxlen=N_LINES)
        self._armed, self._payload_kg, self._n_pages, self._lost = False, 0.0, 0, False
        self._doing, self._goal = "waits", np.full(6, np.nan)
        self.demonstrations, self._takes = TakenPoses(controller.policy), False
        spec = controller.policy.spec
        # Clamped before the first tick, because it takes longer than a tick.
        self._circle = _ROUNDS * [self._clamped(goal) for goal in circle_poses(spec)]
        self._place = _ROUNDS * [self._clamped(goal) for goal in place_poses(spec)]
        self._loads: list[float | None] = []  # payloads [kg] to attach at the next arrivals; None: no change
        # A simulated arm begins by itself, because it can hit nobody.
        self._first: dict[str, Any] = {"circle": True} if hasattr(arm, "time_s") else {}

    def tell(self, text: str) -> None:
        """Print a line, and show it on the page."""
        self._tell(text)
        self._said.append(text)

    def orders(self) -> Order:
        """Return the page's order since the last tick; of several, the safest one counts."""
        # Take the page's messages.
        asked = self._first | self._end.take()
        self._first = {}
        self._count_pages(asked.get("pages", self._n_pages))
        self._takes = "take" in asked
        if "payload_kg" in asked:
            self._carry(asked["payload_kg"])
        if self._end.closed.is_set() and not self._lost:
            self._lost = asked["hold"] = True
            self.tell("the page's server has ended; an arm under pressure holds, Ctrl-C vents it")
        # Stop and Vent come before all else, and disarm.
        if "vent" in asked or "hold" in asked:
            self._armed, self._goal, self._loads = False, np.full(6, np.nan), []
            return "vent" if "vent" in asked else "hold"
        # Goals count once a user has asked for motion.
        self._armed |= not asked.keys().isdisjoint(("circle", "follow", "place"))
        if not asked.keys().isdisjoint(("circle", "follow", "goal")):
            self._loads = []
        if "circle" in asked:
            return self._circle
        if "place" in asked:
            self._loads = _ROUNDS * [None, _OBJECT_KG, None, None, 0.0, None]
            return self._place
        if "goal" in asked and self._armed:
            return [self._clamped(asked["goal"])]
        return None

    def look(self, state: LoopState, row: dict[str, Any]) -> None:
        """Show a tick on the page; attach or release the object at arrivals."""
        if state.arrived and self._loads and (load_kg := self._loads.pop(0)) is not None:
            self._carry(load_kg)
        if self._takes:
            self.tell(self.demonstrations.take(state, row))
        self._doing = _doing(state, self._controller.policy.n_actions)
        self._goal = self._goal if state.goal is None else state.goal  # the last goal stays visible
        policy = self._controller.policy
        look = look_at(row, state.belief.spring_m, policy.spec, policy.tolerance_m, self._payload_kg)
        look = look._replace(goal=self._goal)
        self._end.put(look=look, doing=self._doing, armed=self._armed, lines=tuple(self._said))

    def _carry(self, payload_kg: float) -> None:
        """Hang a mass to the gripper of a simulated arm; the user loads a real gripper."""
        if hasattr(self._arm, "attach"):
            self._arm.attach(payload_kg)
            self._payload_kg = payload_kg

    def _clamped(self, goal: np.ndarray) -> np.ndarray:
        return clamped(self._controller.reachable, goal)

    def _count_pages(self, n_pages: int) -> None:
        if n_pages == 0 < self._n_pages:
            self.tell(f"no page is open; the arm {self._doing}, as it did; Ctrl-C vents it")
        self._n_pages = n_pages


def place_poses(spec: ArmSpec) -> np.ndarray:
    """Return goals (6, 6) [mm, deg]: above, at and above one place, then the same across the circle."""
    sides = circle_poses(spec)[[0, 20]]
    lift = np.array([0.0, 0.0, _LIFT_MM, 0.0, 0.0, 0.0])
    return np.concatenate([[side + lift, side, side + lift] for side in sides])


def _doing(state: LoopState, n_actions: int) -> str:
    """Return the arm's activity as words that follow "the arm"."""
    if state.goal is not None:
        assert isinstance(state.strategy, AtRest | Timed)  # a page's goals do not move
        return f"moves (action {max(state.strategy.n_actions, 1)} of {n_actions})"
    if state.command.reference_m is None:
        return "is being vented" if state.command.pressure_kpa.any() else "has no pressure"
    return "holds"


def live(
    setup: Setup,
    arm: Any,
    tell: Callable[[str], None],
    save: Callable[[Log], None] | None,
    save_demonstrations: Callable[[Log], None] | None,
) -> LoopRun:
    """Steer an arm from a page until something ends it; after a fault the page stays until Ctrl-C.

    `tell` takes a line for the page's address, each arrival and each fault.

    Raises:
        InputError: the page cannot be served.
        OSError: the demonstrations cannot be written.
    """
    from mjx_softarm.view.page import serve

    # Start the page's server.
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs, setup), daemon=True)
    process.start()
    theirs.close()
    end, controller = ChannelEnd(ours), Controller.of(setup.policy)
    try:
        # Steer the arm, then save its poses and tell the end.
        tell(f"open {_address(end)}; Ctrl-C vents the arm and ends")
        if setup.host not in LOCAL:
            warning = "everybody who reaches this address can move the arm; there is no password"
            tell(f"--host {setup.host}: {warning}")
        pilot = PagePilot(end, arm, controller, tell)
        arm = Paced(arm) if hasattr(arm, "time_s") else arm
        run = steer(arm, controller, pilot.orders, pilot.look, pilot.tell, save)
        if save_demonstrations and len(pilot.demonstrations):
            save_demonstrations(pilot.demonstrations.log())
        end.put(ended=run.ending.cause, vented=run.ending.vented)
        if run.ending.status == FAULT:
            tell("the page stays; Ctrl-C ends it")
            with contextlib.suppress(KeyboardInterrupt):
                end.closed.wait()
    finally:
        process.kill()
    return run


def _address(end: ChannelEnd) -> str:
    """Return the page's address once it is served."""
    deadline_s = time.monotonic() + READY_S
    while time.monotonic() < deadline_s and not end.closed.wait(0.02):
        if "failed" in (said := end.take()):
            raise InputError(said["failed"])
        if "url" in said:
            return said["url"]
    raise InputError(f"view: got no page within {READY_S:g} s, expected one")
