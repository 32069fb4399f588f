"""Error budget: the tip's distance from its goals, split into the parts that make it. NumPy only.

The pose goes from the goal to the measured tip in steps. Each step puts the truth in the place of one
ingredient, and what this changes is that ingredient's part:

    goal -> pose of the references -> of the springs -> with the true payload -> without shifted zeros -> tip
        policy                     law              payload                   springs                 models

The last step is the error of the pose's models and of all that they do not know. It is divided by the squares
of the models' held-out errors, which the policy file has: S2R, and the rest, such as hysteresis.
Where nobody says what hangs at the gripper, the loop's estimate of the payload counts as the true payload.

The part of an ingredient is the component of its step along the tip's error: parts add up to the error, and
an ingredient that compensates another has a negative part.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm.deploy.measure import Accuracy
from mjx_softarm.policy.file import Policy
from mjx_softarm.policy.runtime import tip_pose
from mjx_softarm.sensing.pose import pose_error

AS_CALIBRATED = 1.5  # error of the models over their held-out error, up to which nothing has changed; by hand
ZERO_M = 1e-3  # prior of the shift of a spring's zero; by hand
STEP_M = 2e-4  # of the finite differences
MM_PER_DEG = 0.9  # weight of a turn beside a distance, as for the networks of the pose
NAMED_MM = 0.4  # shift of a spring's zero that the sentence names
MIN_GOALS = 8  # goals that show a change of the arm; `calib run --since` refuses fewer
LIGHT = 0.1  # share of the largest payload up to which an arm counts as unloaded; the loop is off by 0.07
# Error of the tip, as a share of the arm's length and over the models' held-out error, from which the models
# may be those of another arm; shift of a zero that no sensor ages by. By hand, after circles of arms 0.6 m
# long. With their own policies, twin 0 and rod 3 are 0.5 and 0.7 mm off, with 500 g 1.0, with 1 kg 3.1, and
# the aged twin 7.2, by zeros that have shifted by 1.4. With others' policies, six arms are 17 to 96 mm off.
WRONG_SHARE, WRONG_RATIO, WRONG_ZERO_MM = 0.01, 3.0, 5.0


class Budget(NamedTuple):
    """Parts of the mean tip error at the goals that were measured."""

    parts_mm: Mapping[str, float]  # by ingredient; their sum is the mean tip error
    shift_mm: np.ndarray  # (n_springs,) shifts of the springs' zeros; zeros where nothing has changed
    believed_g: float  # mean payload that the loop believed
    payload_g: float | None  # payload that hung at the gripper; None: nobody said, so the loop's counts
    off_mm: float  # mean over goals of the largest distance of a spring from its reference
    n_goals: int  # goals that were measured
    n_saturated: int  # goals with a saturated chamber
    loaded: bool  # whether the payload is more than the specification's
    wrong_mm: float  # error from which the models may be those of another arm
    calibrated: bool  # whether the policy has the calibration of an arm

    @property
    def total_mm(self) -> float:
        """Mean tip error."""
        return sum(self.parts_mm.values())

    @property
    def largest(self) -> str:
        """Name of the largest part."""
        return max(self.parts_mm, key=self.parts_mm.__getitem__)

    @property
    def wrong(self) -> bool:
        """Whether the models are hardly those of this arm: far off, by what no change of the springs is."""
        unlike = self.largest == "rest" or bool(np.abs(self.shift_mm).max() > WRONG_ZERO_MM)
        return self.calibrated and unlike and self.total_mm > self.wrong_mm

    def lines(self) -> list[str]:
        """Return the parts in a line, then the sentence that names the largest one and its remedy.

        A line before them says where the payload is the loop's own estimate.
        """
        parts = ", ".join(f"{name} {value:.2f}" for name, value in self.parts_mm.items())
        share = f"{self.largest}, {self.parts_mm[self.largest]:.2f} of {self.total_mm:.2f} mm"
        remedy = _WRONG if self.wrong else _remedies(self)[self.largest]
        lines = [f"made by [mm]: {parts}", f"largest part: {share}: {remedy}"]
        if self.payload_g is None:
            lines.insert(0, f"payload: {self.believed_g:.0f} g by the loop's estimate; --payload gives none")
        return lines

    def figures(self) -> dict[str, Any]:
        """Return parts, shifts and payloads as JSON has them."""
        return {**self._asdict(), "shift_mm": self.shift_mm.tolist(), "largest": self.largest}


_WRONG = (
    "more than a change of the calibrated arm explains: likely another arm, or a wrong calibration: check "
    "which arm and which policy these are, or calibrate this arm (docs/your-arm.md)"
)


def _remedies(parts: Budget) -> dict[str, str]:
    """Return cause and remedy of each part, in words."""
    shifted = np.flatnonzero(np.abs(parts.shift_mm) > NAMED_MM)
    zeros = ", ".join(f"spring{k} {parts.shift_mm[k]:+.1f}" for k in shifted) or "all by little"
    # Remedies of a change; few goals do not show one.
    again = "`python -m calib run LOG --since CALIBRATION` with this log, then `train export --calibration`"
    anew = "record poses anew, and calibrate with them"
    more = "record more random poses, and calibrate with them"
    weigh = "measure a dozen goals with a known weight, and calibrate with them (docs/why.md)"
    if parts.n_goals < MIN_GOALS:
        again = f"{parts.n_goals} goals do not show a change beyond chance: measure {MIN_GOALS} or more"
        anew = again
    off = f"springs end {parts.off_mm:.1f} mm off their references"
    hung_g = parts.payload_g or 0.0
    return {
        "policy": "its references miss the goals by its own models: train longer, or by the preset analytic",
        "law": f"{off}, saturated at {parts.n_saturated} goals: take goals further inside, or less payload"
        if parts.n_saturated
        else f"{off} although no chamber is saturated: look for a leak or a slow regulator",
        "payload": f"the loop believes {parts.believed_g:.0f} g, and --payload says {hung_g:.0f} g: {weigh}",
        "springs": f"zeros have shifted since the calibration, about [mm]: {zeros}: {again}",
        "S2R": f"as large as at the calibration's held-out poses: {more}",
        # `--since` fits the springs' zeros, which explain the part `springs` alone.
        "rest": "the policy does not know this arm: calibrate it and train (docs/your-arm.md)"
        if not parts.calibrated
        else "the models have learned without a payload: measure without one, which shows what else is off"
        if parts.loaded
        else "the pose changes as no spring shows, as by hysteresis, or the arm has changed: " + anew,
    }


def budget(accuracy: Accuracy, policy: Policy, payload_kg: float | None) -> Budget | None:
    """Return the budget of a run towards goals, stop by stop; None if no goal was measured.

    The payload is that which hung at the gripper; None: the one that the loop believed.
    """
    # The goals at which motion capture saw the tip and the springs were read
    measured = np.isfinite(np.hstack([accuracy.error, accuracy.spring_m])).all(axis=1)
    if not measured.any():
        return None
    goal, seen, _, spring_m, reference_m, mask, load_kg = (values[measured] for values in accuracy)
    true_kg = load_kg if payload_kg is None else np.full_like(load_kg, payload_kg)

    # Poses with one more ingredient replaced by the truth each, then the models' error
    cases = (reference_m, load_kg), (spring_m, load_kg), (spring_m, true_kg)
    off = [pose_error(tip_pose(policy, *case)[0].astype(float), goal) for case in cases]
    steps = np.diff([np.zeros_like(goal), *off, seen], axis=0).swapaxes(0, 1)  # (p, 4, 6)

    # The models' error, with the part that shifted zeros explain. Where it is no larger than at the
    # calibration, none have shifted. With a payload it is not theirs alone: the models learned without one.
    # Models that are far off misread the payload, too
    s2r_mm = 0.0 if policy.s2r is None else float(policy.s2r.error_mm)
    wrong_mm = max(1e3 * WRONG_SHARE * policy.spec.length_m, WRONG_RATIO * s2r_mm)
    left = pose_error(seen, off[-1])
    left_mm = np.linalg.norm(left[:, :3], axis=1).mean()
    mass = policy.spec.mass
    loaded = float(true_kg.mean()) - mass.payload_kg > LIGHT * mass.largest_payload_kg
    loaded &= payload_kg is not None or bool(left_mm < wrong_mm)
    shift_m, by_shift = np.zeros(spring_m.shape[1]), np.zeros_like(left)
    if not loaded and s2r_mm and left_mm > AS_CALIBRATED * s2r_mm:
        shift_m, by_shift = _shift(policy, spring_m, left, true_kg, s2r_mm)
    each = steps[..., :3] * policy.reward.asked[:3]
    by_shift = by_shift[:, :3] * policy.reward.asked[:3]
    each = np.concatenate([each[:, :3], by_shift[:, None], each[:, 3:] - by_shift[:, None]], axis=1)
    error = each.sum(axis=1)
    along = error / np.maximum(np.linalg.norm(error, axis=1), 1e-9)[:, None]
    *parts, models = (float(x) for x in np.einsum("pki,pi->pk", each, along).mean(axis=0))

    # The models' part, of which S2R has as much as at held-out poses
    size = max(float(np.mean(np.linalg.norm(each[:, -1], axis=1) ** 2)), s2r_mm**2)
    by_s2r = models * s2r_mm**2 / max(size, 1e-12)
    named = dict(zip(("policy", "law", "payload", "springs"), parts, strict=True))
    return Budget(
        parts_mm=named | {"S2R": by_s2r, "rest": models - by_s2r},
        shift_mm=1e3 * shift_m,
        believed_g=1e3 * float(load_kg.mean()),
        payload_g=None if payload_kg is None else 1e3 * payload_kg,
        off_mm=1e3 * float(np.abs(spring_m - reference_m).max(axis=1).mean()),
        n_goals=len(goal),
        n_saturated=int(mask.any(axis=1).sum()),
        loaded=loaded,
        wrong_mm=wrong_mm,
        calibrated=policy.calibrated,
    )


def _shift(
    policy: Policy, spring_m: np.ndarray, left: np.ndarray, payload_kg: np.ndarray, expected_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return shifts (n,) [m] of the springs' zeros, true length minus length read, and errors that they make.

    Args:
        policy: with the models.
        spring_m (p, n) [m]: lengths as read.
        left (p, 6) [mm, deg]: measured pose minus that of the models.
        payload_kg (p,): payload at the gripper.
        expected_mm: the models' held-out error.
    """
    # Derivatives of the pose by finite differences, then least squares with a prior
    n = spring_m.shape[1]
    pose = tip_pose(policy, spring_m, payload_kg)[0].astype(float)
    beside = tip_pose(policy, spring_m[:, None] + STEP_M * np.eye(n), payload_kg[:, None])[0].astype(float)
    slope = pose_error(beside, pose[:, None]) / STEP_M  # (p, n, 6) [mm/m, deg/m]
    weight = np.array([1.0, 1.0, 1.0, *3 * (MM_PER_DEG,)]) * 3**0.5 / expected_mm  # per axis
    rows = (slope * weight).swapaxes(1, 2).reshape(-1, n) * ZERO_M
    normal = rows.T @ rows + np.eye(n)
    shift_m = ZERO_M * np.linalg.solve(normal, rows.T @ (left * weight).ravel())
    return shift_m, np.einsum("pnk,n->pk", slope, shift_m)


def draw(parts: Budget, path: Path) -> None:
    """Draw the parts as bars, the largest first; needs matplotlib."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 2.8), layout="constrained")
    axes = figure.subplots()
    names, values = zip(*sorted(parts.parts_mm.items(), key=lambda item: item[1]), strict=True)
    colours = ["tab:red" if name == parts.largest else "tab:blue" for name in names]
    axes.bar_label(axes.barh(names, values, color=colours), fmt="%.2f", padding=3)
    axes.set(xlabel=f"part of the mean tip error of {parts.total_mm:.2f} mm [mm]")
    axes.margins(x=0.12)
    axes.axvline(0.0, color="black", lw=0.8)
    figure.savefig(path, dpi=150)
