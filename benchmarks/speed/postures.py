"""Equilibria of arms that hang, lie and stand, beside C MuJoCo's arms that hold references under the law.

Arms that stand are heavy for their stiffness: with a payload they would buckle at constant pressures, and the
law holds them. Both begin at the straight arm. Settling may end on another branch than the motion does, so
the arms that end more than `ELSEWHERE_MM` apart are counted.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness.common import n_cores
from benchmarks.speed.mujoco_arms import SteppedArms, sensed_model
from benchmarks.speed.truth import QUANTILES, random_references, rest_of
from mjx_softarm.mechanics.settle import SettleResult
from mjx_softarm.spec import ArmSpec

TURNS_DEG = {"hangs": (0.0, 0.0, 0.0), "lies": (90.0, 0.0, 0.0), "stands": (180.0, 0.0, 0.0)}
# Share of its own mass, shares of its largest payload. The paper's arm is too heavy to lie or stand.
ARMS = {"stiff-flop": (1.0, (0.0, 0.5, 1.5)), "paper": (0.1, (0.0, 1.0))}
N_ARMS = 64
HOLD_S = 30.0  # time of motion
STILL_S, STILL_MM = 1.0, 0.02  # an arm rests whose tip moved by less at the end
ELSEWHERE_MM = 5.0


def rows() -> list[dict[str, Any]]:
    """Return a row for each arm, posture and payload."""
    return [row | figures(spec) for row, spec in _cases()]


def _cases() -> Iterator[tuple[dict[str, Any], ArmSpec]]:
    for name, (lighter, shares) in ARMS.items():
        whole = ArmSpec.of(Path(name))
        masses = {item: lighter * getattr(whole.mass, item) for item in ("arm_kg", "gripper_kg")}
        for posture, turn_deg in TURNS_DEG.items():
            for share in shares:
                spec = whole.replace(mass=masses, mounting={"base_turn_deg": turn_deg})
                payload_kg = round(share * spec.mass.largest_payload_kg, 4)
                row = {"arm": name, "mass_share": lighter, "posture": posture, "payload_kg": payload_kg}
                yield row, spec.replace(mass={"payload_kg": payload_kg})


def figures(spec: ArmSpec) -> dict[str, Any]:
    """Return how settled arms compare with C MuJoCo's at random references."""
    # Equilibria, and arms that hold the same references until they rest
    reference_m = random_references(spec, N_ARMS)
    found = rest_of(spec, reference_m)
    tips_mm = SteppedArms(sensed_model(spec), spec, N_ARMS, n_cores()).hold(reference_m, HOLD_S)
    last_mm = tips_mm[-round(STILL_S * spec.control.rate_hz) :]
    rests = np.linalg.norm(np.ptp(last_mm, axis=0), axis=-1) < STILL_MM

    # Codes, and distances of the arms that settled and rest
    settled, both = found.settled, found.settled & rests
    away_mm = np.linalg.norm(1e3 * found.tip_position_m - tips_mm[-1], axis=-1)[both]
    same_mm = away_mm[away_mm <= ELSEWHERE_MM]
    errors = {}
    if len(same_mm):
        errors = {name: float(f"{np.quantile(same_mm, share):.3g}") for name, share in QUANTILES.items()}
    codes = {result.name.lower(): int(np.sum(found.result == result.value)) for result in SettleResult}
    return {
        **codes,
        "settled_and_rest": int(both.sum()),
        **errors,
        "elsewhere": int(np.sum(away_mm > ELSEWHERE_MM)),
        "settled_but_moves": int(np.sum(settled & ~rests)),
        "rests_but_not_settled": int(np.sum(rests & ~settled)),
    }
