"""A policy file's exports for other runtimes: ONNX graphs, C++ sources, golden rows."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from mjx_softarm._support.errors import needing
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.export import computations
from mjx_softarm.export.cpp import sources
from mjx_softarm.export.golden import Golden, make_golden, write_golden
from mjx_softarm.mdp.observation import RATE_S
from mjx_softarm.policy.file import LAW, Policy, action_layout, load_policy
from mjx_softarm.posture import straight_pose

_POSE = {"unit": ["mm"] * 3 + ["deg"] * 3, "names": ["x", "y", "z", "yaw", "pitch", "roll"]}
FRAME = "base frame: z up; angles intrinsic Z-Y-X; the tip of the straight arm is at {}"


def export_onnx(policy_path: Path) -> list[Path]:
    """Write a policy's graphs and golden rows beside its file; return the written files.

    Raises:
        InputError: the policy cannot be read, the package onnx is missing, or a file cannot be written.
    """
    with needing("onnx", "--onnx"):
        from mjx_softarm.export.onnx_files import write_onnx
    # Inputs that may be left out, with their defaults.
    controller, sha256 = _open(policy_path)
    spec = controller.policy.spec
    about = describe(controller.policy, sha256)
    whole, actor, check = (
        policy_path.with_name(f"{policy_path.stem}{end}.onnx") for end in ("", "_actor", "_check")
    )
    unknown_m, unknown_kpa = np.full(spec.n_springs, np.nan), np.full(spec.n_chambers, np.nan)
    never = {"last_length_m": unknown_m, "load_kg": spec.mass.payload_kg, "pressure_kpa": unknown_kpa}
    never["stop"] = np.zeros(spec.n_chambers)
    if controller.policy.observation == "motion":
        never |= computations.InMotion(unknown_m, unknown_m, np.zeros(spec.n_chambers))._asdict()
    # Write the graphs and the golden rows.
    write_onnx(whole, computations.graph(controller), {"kind": "policy", **about}, never)
    write_onnx(actor, computations.actor(controller), {"kind": "actor", **about}, {})
    write_onnx(check, computations.check(controller), {"kind": "check of goals", **about}, {})
    golden = policy_path.with_name(f"{policy_path.stem}_golden.csv")
    write_golden(golden, _golden(policy_path, sha256))
    return [whole, actor, check, golden]


def export_cpp(policy_path: Path, folder: Path) -> list[Path]:
    """Write a policy as C++ sources and golden rows into a folder; return the written files.

    Raises:
        InputError: the policy cannot be read.
        OSError: a file cannot be written.
    """
    controller, sha256 = _open(policy_path)
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name, text in sources(controller, sha256).items():
        files.append(folder / name)
        files[-1].write_text(text, "utf-8")
    write_golden(folder / "golden.csv", _golden(policy_path, sha256))
    return [*files, folder / "golden.csv"]


def describe(policy: Policy, sha256: str) -> dict[str, Any]:
    """Return a graph's description for its users: units, frames, names, the arm and its numbers."""
    # Units and names that occur several times.
    sensor = policy.sensor
    lengths = {"unit": "m", "names": [f"spring{k}" for k in range(policy.spec.n_springs)]}
    readings = {"unit": sensor.unit, "names": list(action_layout(policy.spec))}
    # Inputs and outputs of all graphs, then the arm's numbers.
    return {
        "policy_sha256": sha256,
        "frame": FRAME.format(", ".join(f"{value:g}" for value in straight_pose(policy.spec))),
        "inputs": {
            "readings": readings,
            "goal": _POSE,
            "last_length_m": lengths | {"default": "nan: none yet; a lost reading holds it"},
            "load_kg": {
                "unit": "kg",
                "default": "the specification's: load_estimate_kg, averaged over static poses",
            },
            "pressure_kpa": {"unit": "kPa", "default": "nan: not known; of the arm at rest"},
            "stop": {"default": "0: not known; next_stop of the last tick"},
            "before_m": lengths | {"default": f"nan: not known; {RATE_S:g} s before"},
            "last_reference_m": lengths | {"default": "nan: none yet; of the last action"},
            "integral_kpa": {"unit": "kPa", "default": "0; of the law"},
            "observation": {"kind": policy.observation, "names": list(policy.obs_layout)}
            | {name: value.tolist() for name, value in policy.obs_scale._asdict().items()},
        },
        "outputs": {
            "reference_m": lengths | {"nan": "no length of a spring, or a goal outside the workspace"},
            "reference_reading": readings,
            "length_m": lengths,
            "reading_lost": {"names": lengths["names"]},
            "pose": _POSE,
            "extrapolation": {"above 1": "the pose is further from the calibration than is believed"},
            "goal_outside": {"true": "the goal is outside the workspace"},
            "nearest": _POSE,
            "error": {"above": policy.reward.threshold, "means": "no pressures reach the goal"},
            "load_estimate_kg": {"unit": "kg", "nan": "without pressures"},
            "load_half_width_kg": {"unit": "kg", "nan": "without pressures"},
            "next_stop": {"range": [-1.0, 1.0]},
            "action": {"names": readings["names"], "range": [-1.0, 1.0]},
        },
        "rate_hz": policy.rate_hz,
        "tolerance_m": policy.tolerance_m,
        "n_actions": policy.n_actions,
        "action_s": policy.action_s,
        "gains": {name: np.asarray(getattr(policy.gains, name)).tolist() for name in LAW},
        "spec": policy.spec.to_dict(),
        "provenance": dict(policy.provenance),
    }


@functools.lru_cache(maxsize=1)
def _golden(policy_path: Path, sha256: str) -> Golden:
    """Return a policy's golden rows; graphs and sources of one export share them."""
    return make_golden(Controller.of(load_policy(policy_path)), sha256)


def _open(policy_path: Path) -> tuple[Controller, str]:
    sha256 = hashlib.sha256(policy_path.read_bytes()).hexdigest()
    return Controller.of(load_policy(policy_path)), sha256
