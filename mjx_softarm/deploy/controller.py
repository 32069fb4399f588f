"""A policy made ready for the control loop, and a command of the loop. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from mjx_softarm.control import LawState
from mjx_softarm.deploy.moving.lead import RATE_S, Plan, tip_lag_s
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.lag import RestRule, middle_kpa, rest_rule, spring_lag_s
from mjx_softarm.policy.reachable import Reachable
from mjx_softarm.policy.runtime import PolicyRunner
from mjx_softarm.spec import ArmSpec


@dataclass(frozen=True, eq=False)
class Controller:
    """A policy made ready for the loop."""

    policy: Policy
    reachable: Reachable
    plan: Plan  # pose and goal (6,), springs (n_springs,) [m], `sensed` of `PolicyRunner.act` -> references
    dt_s: float
    rest: RestRule
    observes_payload: bool

    @classmethod
    def of(cls, policy: Policy, plan: Plan | None = None) -> Controller:
        """Make a policy ready; `plan` replaces its actor, for another way to find references."""
        runner = PolicyRunner(policy)
        lag_s = spring_lag_s(policy, middle_kpa(policy.gains, policy.spec.n_chambers))
        return cls(
            policy=policy,
            reachable=Reachable.from_poses(policy.workspace, policy.reward),
            plan=plan or (lambda pose, goal, _, sensed: runner.act(pose, goal, sensed).length_m),
            dt_s=1.0 / policy.rate_hz,
            rest=rest_rule(policy.spec, lag_s),
            observes_payload=policy.observation == "payload",
        )

    @property
    def window(self) -> int:
        """Number of ticks over which springs are watched."""
        return self.rest.window

    @cached_property
    def lead_s(self) -> float:
        """Time by which a moving goal is given ahead; for a policy of motion it takes seconds to find."""
        policy = self.policy
        if policy.action_s:
            return self._whole_ticks(max(0.0, tip_lag_s(policy, self.plan)))
        return float(np.mean(policy.gains.reference_s)) + 0.5 * RATE_S

    @property
    def start_s(self) -> float:
        """Time, of whole ticks, until an arm at rest answers to a goal that begins to move."""
        if self.policy.action_s:
            return self.lead_s
        # The rate of the references is known after `RATE_S`, and the actuators have a dead time
        return self._whole_ticks(RATE_S + float(np.mean(self.policy.spec.actuators.delay_s)))

    def _whole_ticks(self, time_s: float) -> float:
        return round(time_s * self.policy.rate_hz) / self.policy.rate_hz


class Command(NamedTuple):
    """References and pressures in force."""

    reference_m: np.ndarray | None  # (n_springs,) None: the pressures go to zero
    n_ticks: int  # ticks since the references or the goal were new
    law: LawState  # NaN lengths before the first reading
    pressure_kpa: np.ndarray  # (n_chambers,)

    @classmethod
    def none(cls, spec: ArmSpec) -> Command:
        """Return the command of an arm without pressure."""
        zero_kpa, unknown_m = np.zeros(spec.n_chambers), np.full(spec.n_springs, np.nan)
        return cls(None, 0, LawState.at_rest(zero_kpa, unknown_m), zero_kpa)
