"""Actions of the loop: when the policy acts, on which belief, and towards which goal. Pure; NumPy only.

`mjx_softarm.deploy.loop` says how these follow one another.
"""

from __future__ import annotations

import numpy as np

from mjx_softarm.control import saturated
from mjx_softarm.deploy import faults
from mjx_softarm.deploy.controller import Controller, State
from mjx_softarm.deploy.faults import Event, Fault
from mjx_softarm.mdp.observation import rate_ticks
from mjx_softarm.mdp.rewards import scaled_error
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.runtime import InMotion, sensed, tip_pose
from mjx_softarm.sensing.load import Load
from mjx_softarm.sensing.pose import pose_error

MAX_SHIFT = np.repeat([25.0, 5.0], 3)  # [mm, deg] of a goal
MAX_KEPT = np.repeat([10.0, 2.0], 3)  # of the next one; what goes beyond is of a goal that is out of reach
SHARES = (1.0, 0.5, 0.25)  # of what is left, by which an action may shift the goal: the first that will do
MOVING_SHARE = 0.05  # of what is left to where the tip should be, by which an action shifts a moving goal


def believed(controller: Controller, spring_m: np.ndarray, load: Load) -> tuple[np.ndarray, float]:
    """Return the tip pose of springs (n,) [m] with a payload.

    Returns:
        Pose (6,) [mm, deg], NaN where a length is; `s2r.extrapolation` of it, 0 without a network.
    """
    if np.isnan(spring_m).any():
        return np.full(6, np.nan), 0.0
    pose, away = tip_pose(controller.policy, spring_m, load.believed_kg)
    return pose, float(away)


def go(controller: Controller, state: State, at_rest: bool) -> tuple[State, list[Event], bool]:
    """Act if the goal is new or the springs have settled; arrive when they have after the last action.

    A further action at rest that would lead away from the goal is tried with smaller shifts; where none will
    do, the arm has arrived.
    """
    policy, events = controller.policy, list[Event]()
    shifts, allowed = [state.shift], None  # to try in turn; weighted error that an action may leave
    assert state.goal is not None  # `step` asks
    if state.n_actions > 0:
        assert state.reference_m is not None
        seen = state.springs_m, state.reference_m, state.pressure_kpa
        settled = at_rest and bool(faults.on_reference(*seen, policy.gains, policy.tolerance_m))
        if not settled and state.n_ticks * controller.dt_s < _patience_s(policy, state.n_actions):
            return state, [], False
        if state.n_suspect.any() and settled:  # whether a chamber is lost comes first
            return state, [], False
        if not policy.action_s or state.n_actions == policy.n_actions:
            events += _unsettled(controller, state, settled)
        if settled:
            # What a payload bends is made up for once: where the policy observes it, by its next action.
            load = state.acted_load if policy.observation == "payload" else state.load
            left = pose_error(_made(controller, state, state.reference_m, load), state.goal)
            shifts = [_clipped(state.shift - share * left) for share in SHARES]
        if state.n_actions == policy.n_actions:
            return _arrived(state, shifts[0]), events, True
        if settled and not policy.action_s:
            allowed = max(_error(controller, state, state.reference_m), policy.reward.threshold)
    elif not policy.action_s:  # it makes up for what is left with its next actions
        shifts = [np.zeros(6)]
    pose, away = believed(controller, state.spring_m, state.load)
    if away > 1.0:
        message = f"{away:.1f} times as far from the training rows as the network is believed"
        events.append(Event(Fault.EXTRAPOLATION, message))
    for shift in shifts:
        reference_m = _planned(controller, state, pose, shift)
        if allowed is None or not _error(controller, state, reference_m) > allowed:
            break
    else:
        return _arrived(state, state.shift), events, True
    acted = {"reference_m": reference_m, "shift": shift, "acted_load": state.load}
    return state._replace(**acted, n_actions=state.n_actions + 1, n_ticks=0), events, False


def chase(controller: Controller, state: State) -> State:
    """Return the state with the references towards a moving goal, if an action is due."""
    policy = controller.policy
    assert state.goal is not None  # `step` asks
    pose, _ = believed(controller, state.spring_m, state.load)
    shift, due = state.shift, state.due
    if policy.action_s:
        if state.n_actions and state.n_ticks * controller.dt_s < policy.action_s:
            return state
        shift = _clipped(shift - MOVING_SHARE * _beside(np.asarray(pose, float), due))
        reference_m = _planned(controller, state, pose, shift)
        due = np.concat([due[1:], state.goal[None]])
    else:
        reference_m = state.spring_m
        for _ in range(policy.n_actions):
            reference_m = _planned(controller, state, pose, shift)
            pose, _ = believed(controller, reference_m, state.load)
            left = pose_error(np.asarray(pose, float), state.goal)
            shift = _clipped(shift - left)
    n_actions = state.n_actions + 1
    return state._replace(reference_m=reference_m, n_actions=n_actions, n_ticks=0, shift=shift, due=due)


def _patience_s(policy: Policy, n_actions: int) -> float:
    """Return for how long [s] the springs may move until the next action comes, or the arrival."""
    more = policy.action_s and n_actions < policy.n_actions
    return policy.action_s if more else faults.SETTLE_TIMEOUT_S


def _planned(controller: Controller, state: State, pose: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return references (n,) [m] from a believed pose (6,) towards the goal with a shift (6,)."""
    policy = controller.policy
    assert state.goal is not None
    before_m = state.springs_m[-1 - min(rate_ticks(policy.rate_hz), len(state.springs_m) - 1)]
    last_m = np.full_like(before_m, np.nan) if state.reference_m is None else state.reference_m
    motion = InMotion(before_m, last_m, state.law.integral_kpa)
    observed = sensed(policy, pose, state.spring_m, motion, state.load.believed_kg)
    return controller.plan(pose, state.goal + shift, state.spring_m, observed)


def _arrived(state: State, shift: np.ndarray) -> State:
    """Return the state without its goal, with what the next goal keeps of a shift (6,) [mm, deg]."""
    return state._replace(goal=None, shift=_clipped(shift, MAX_KEPT))


def _error(controller: Controller, state: State, reference_m: np.ndarray) -> float:
    """Return the weighted error at the goal that references (n,) [m] leave with the estimated payload."""
    assert state.goal is not None
    pose = _made(controller, state, reference_m, state.load)
    return float(np.linalg.norm(scaled_error(pose, state.goal, controller.policy.reward)))


def _made(controller: Controller, state: State, reference_m: np.ndarray, load: Load) -> np.ndarray:
    """Return the pose (6,) [mm, deg] that references (n,) [m] make of an arm that rests on the last ones.

    References, not springs, since these may creep by some tenths of a millimetre in an arm at rest; but the
    springs of saturated chambers that are asked for more, which do not follow.
    """
    assert state.reference_m is not None
    policy, mean_m = controller.policy, state.springs_m.mean(axis=0)
    mask = saturated(state.pressure_kpa, state.reference_m, mean_m, policy.gains, policy.tolerance_m)
    stays = mask & ((reference_m - mean_m) * (state.reference_m - mean_m) > 0.0)
    return np.asarray(believed(controller, np.where(stays, mean_m, reference_m), load)[0], float)


def _beside(pose: np.ndarray, due: np.ndarray) -> np.ndarray:
    """Return how far a pose (6,) is beside the way of a goal (k, 6), from where that was first; 0 without.

    Along the way it may lag, or be ahead, which is no offset.
    """
    if np.isnan(due).any():
        return np.zeros(6)
    left, along = pose_error(pose, due[0]), pose_error(due[-1], due[0])[:3]
    left[:3] -= along * (left[:3] @ along) / max(along @ along, 1e-12)
    return left


def _clipped(shift: np.ndarray, limit: np.ndarray = MAX_SHIFT) -> np.ndarray:
    return np.clip(shift, -limit, limit)


def _unsettled(controller: Controller, state: State, settled: bool) -> list[Event]:
    """Return the faults of the springs as they stand before the next action."""
    policy, mean_m = controller.policy, state.springs_m.mean(axis=0)
    off_m = mean_m - state.reference_m
    mask = saturated(state.pressure_kpa, state.reference_m, mean_m, policy.gains, policy.tolerance_m)
    events = []
    if not settled:
        worst = int(np.argmax(np.where(mask, 0.0, np.abs(off_m))))
        off = f"{1e3 * off_m[worst]:+.1f} mm"
        message = f"after {faults.SETTLE_TIMEOUT_S:g} s, spring{worst} is {off} off its reference"
        events.append(Event(Fault.NOT_SETTLED, message))
    if mask.any():
        off = ", ".join(f"{1e3 * value:+.1f}" for value in off_m[mask])
        message = f"{names('chamber', mask)}: at the limit, spring {off} mm off its reference"
        events.append(Event(Fault.SATURATED, message))
    return events


def names(kind: str, mask: np.ndarray) -> str:
    """Return the names of springs or chambers of a mask (n,)."""
    return ", ".join(f"{kind}{k}" for k in np.flatnonzero(mask))
