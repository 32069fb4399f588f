"""The control loop's controller and what it remembers: settings, state and outcome of a tick. NumPy only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mjx_softarm.control import LawState
from mjx_softarm.deploy.faults import Event, Response
from mjx_softarm.deploy.reachability import Reachable
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.runtime import PolicyRunner
from mjx_softarm.sensing.load import Load

WINDOW_S = 0.5

Plan = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None], np.ndarray]

LEAD_ACTIONS = 2  # of a moving goal before the tip, by policies of motion: they lag so on twins
NONE_DUE = np.full((LEAD_ACTIONS, 6), np.nan)


@dataclass(frozen=True, eq=False)
class Controller:
    """A policy made ready for the loop."""

    policy: Policy
    reachable: Reachable
    plan: Plan  # pose and goal (6,), springs (n,) [m], `sensed` of `PolicyRunner.act` -> references (n,) [m]
    dt_s: float
    window: int  # ticks

    @classmethod
    def of(cls, policy: Policy, plan: Plan | None = None) -> Controller:
        """Make a policy ready; `plan` replaces its actor, for another way to find references."""
        runner = PolicyRunner(policy)
        return cls(
            policy=policy,
            reachable=Reachable.from_poses(policy.workspace, policy.reward),
            plan=plan or (lambda pose, goal, _, sensed: runner.act(pose, goal, sensed).length_m),
            dt_s=1.0 / policy.rate_hz,
            window=max(2, round(WINDOW_S * policy.rate_hz)),
        )


class State(NamedTuple):
    """Memory of the loop from tick to tick, for n springs and chambers."""

    goal: np.ndarray | None  # (6,) [mm, deg]
    moves: bool  # the goal is another one in every tick
    n_actions: int  # for this goal
    n_ticks: int  # since the last action
    n_late: int  # missed deadlines in a row
    spring_m: np.ndarray  # (n,) last good lengths; NaN before the first
    n_lost: np.ndarray  # (n,) lost readings in a row
    n_suspect: np.ndarray  # (n,) ticks in a row in which a chamber seemed to have lost its pressure
    reference_m: np.ndarray | None  # (n,)
    law: LawState  # (n,) each; NaN lengths before the first reading
    pressure_kpa: np.ndarray  # (n,) in force
    springs_m: np.ndarray  # (ticks, n) readings of the last window, the newest last
    pressures_kpa: np.ndarray  # (ticks, n) in force at these
    chambers_kpa: np.ndarray  # (ticks, n) measured at these, or in force where none was measured
    load: Load  # payload, estimated at rest
    acted_load: Load  # the same at the last action
    n_unweighed: int  # ticks since the payload was last estimated
    shift: np.ndarray  # (6,) [mm, deg] of the goals that the policy is given
    due: np.ndarray  # (LEAD_ACTIONS, 6) [mm, deg] moving goal at the last actions, oldest first; NaN: none


class Tick(NamedTuple):
    """Results of a tick besides the next state."""

    spring_m: np.ndarray  # (n,) lengths believed in; NaN before the first reading
    events: tuple[Event, ...]
    arrived: bool  # the springs have settled, and no further action is due

    @property
    def stop(self) -> Event | None:
        """First event that ends the run, if there is one."""
        return next((event for event in self.events if event.response is Response.VENT), None)


def start(controller: Controller) -> State:
    """Return the state before the first tick, of an arm without pressure."""
    n = controller.policy.spec.n_chambers
    return State(
        goal=None,
        moves=False,
        n_actions=0,
        n_ticks=0,
        n_late=0,
        spring_m=np.full(n, np.nan),
        n_lost=np.zeros(n, int),
        n_suspect=np.zeros(n, int),
        reference_m=None,
        law=LawState.at_rest(np.zeros(n), np.full(n, np.nan)),
        pressure_kpa=np.zeros(n),
        springs_m=np.empty((0, n)),
        pressures_kpa=np.empty((0, n)),
        chambers_kpa=np.empty((0, n)),
        load=Load(controller.policy.spec.mass.payload_kg),
        acted_load=Load(controller.policy.spec.mass.payload_kg),
        n_unweighed=0,
        shift=np.zeros(6),
        due=NONE_DUE,
    )
