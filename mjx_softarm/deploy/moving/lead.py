"""Lead of a moving goal for a policy of motion: its tip's lag, by its own models. NumPy only."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mjx_softarm.control import LawState, pressures
from mjx_softarm.mdp.observation import rate_ticks
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.lag import ShapeLag
from mjx_softarm.policy.runtime import InMotion, sensed, tip_pose
from mjx_softarm.sensing.estimator import expected_springs
from mjx_softarm.sensing.pose import pose_error

# From pose and goal (6,), springs (n_springs,) [m] and `sensed` of `PolicyRunner.act` to references
Plan = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None], np.ndarray]

# Time over which the rate of the references towards a moving goal is taken, for `spring_lag_s`, of policies
# at rest
RATE_S = 0.2

# Goals that swing between two poses; by hand
_N_SWINGS = 4
_SWING_S = 10.0  # period; slow enough for the phase to be a lag
_SWING = 0.3  # largest difference of the poses' pressures from the middle, in ranges of pressure


def tip_lag_s(policy: Policy, plan: Plan) -> float:
    """Return the time [s] by which the tip of an arm with a policy of motion is behind a moving goal.

    Goals swing sinusoidally between two poses that the arm reaches. The lag is the phase of the tip's motion
    along the line between them, after half a period; the median of several goals.
    """
    rng, n_ticks = np.random.default_rng(0), round(_SWING_S * policy.rate_hz)
    low, high = policy.gains.pressure_min_kpa, policy.gains.pressure_max_kpa
    phase = 2.0 * np.pi * np.arange(3 * n_ticks // 2) / n_ticks

    lags_s = []
    for _ in range(_N_SWINGS):
        shares = 0.5 + _SWING * rng.uniform(-1.0, 1.0, (2, policy.spec.n_chambers))
        ends_kpa = low + (high - low) * shares
        first, last = (
            _pose(policy, spring_m) for spring_m in expected_springs(policy.spring_model, ends_kpa)
        )
        swing = pose_error(last, first)
        goals = first + 0.5 * (1.0 - np.cos(phase))[:, None] * swing
        along = _tip_path(policy, plan, ends_kpa[0], goals) @ swing[:3]
        phasor = -np.sum((along * np.exp(1j * phase))[-n_ticks:])  # of the tip, relative to the goal
        lags_s.append(np.angle(phasor) / (2.0 * np.pi) * _SWING_S)
    return float(np.median(lags_s))


def _tip_path(policy: Policy, plan: Plan, pressure_kpa: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Return the tip's positions (t, 3) [mm] for goals (t, 6) of ticks, of an arm that begins at rest.

    The law, the actuators and the shape move in time; springs are those at rest with the pressures. Chambers
    have the volumes of the straight arm.
    """
    # The arm at rest
    spec, dt_s = policy.spec, 1.0 / policy.rate_hz
    straight_m = spec.at_chambers(spec.geometry.section_length_m)
    air = spec.pneumatics(straight_m, dt_s)
    air.hold(pressure_kpa, straight_m)
    spring_m = _springs(policy, pressure_kpa)
    law = LawState.at_rest(pressure_kpa, spring_m)

    # References and pressures of each tick
    lengths_m, references_m, tip_mm, shape = [spring_m], [spring_m], [], ShapeLag()
    for goal in goals:
        shape, behind = shape.after(policy, spring_m, 0.0, dt_s)
        at_rest = _pose(policy, spring_m)
        pose = at_rest - behind
        tip_mm.append(pose[:3])
        motion = InMotion(lengths_m[0], references_m[0], law.integral_kpa)
        reference_m = plan(pose, goal, spring_m, sensed(policy, at_rest, spring_m, motion, 0.0))
        command_kpa, law = pressures(reference_m, spring_m, law, policy.gains, dt_s)
        air.command(command_kpa)
        spring_m = _springs(policy, air.step(straight_m))
        lengths_m = [*lengths_m, spring_m][-1 - rate_ticks(policy.rate_hz) :]
        references_m = [*references_m, reference_m][-max(1, round(policy.action_s / dt_s)) :]
    return np.array(tip_mm)


def _springs(policy: Policy, pressure_kpa: np.ndarray) -> np.ndarray:
    return np.asarray(expected_springs(policy.spring_model, pressure_kpa), float)


def _pose(policy: Policy, spring_m: np.ndarray) -> np.ndarray:
    return np.asarray(tip_pose(policy, spring_m, 0.0)[0], float)
