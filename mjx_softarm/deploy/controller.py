"""A policy made ready for the control loop. NumPy only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.lag import RestRule, middle_kpa, rest_rule, spring_lag_s
from mjx_softarm.policy.reach import Reachable
from mjx_softarm.policy.runtime import PolicyRunner


@dataclass(frozen=True, eq=False)
class Controller:
    """A policy, and what the loop computes of it once."""

    policy: Policy
    reachable: Reachable
    # From pose and goal (6,), springs (n_springs,) [m] and `sensed` of `PolicyRunner.act` to references
    plan: Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None], np.ndarray]
    dt_s: float
    rest: RestRule
    observes_payload: bool

    @classmethod
    def of(cls, policy: Policy, plan: Callable[..., np.ndarray] | None = None) -> Controller:
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
