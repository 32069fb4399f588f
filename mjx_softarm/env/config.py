"""Settings of the environment: how the arm is simulated, what differs from episode to episode, what pays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from mjx_softarm.control import TOLERANCE_M
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.mechanics.pipe import CrossPipe
from mjx_softarm.mechanics.workspace import HELD_OUT_SEED


@dataclass(frozen=True)
class Randomisation:
    """Differences from episode to episode; with all at zero every arm is the nominal one."""

    payload_max_kg: float = 0.0  # the payload is uniform from the spec's to this much more
    stiffness_spread: float = 0.0  # each chamber's stiffness is times 1 + uniform(-spread, spread)
    sensor_noise_mm: float = 0.0  # standard deviation of each spring's reading, fixed within an episode

    def __post_init__(self):
        if self.payload_max_kg < 0:
            raise ValueError(f"Randomisation.payload_max_kg: got {self.payload_max_kg}, expected >= 0")
        if not 0 <= self.stiffness_spread < 1:
            raise ValueError(f"Randomisation.stiffness_spread: got {self.stiffness_spread}, expected 0 to 1")
        if self.sensor_noise_mm < 0:
            raise ValueError(f"Randomisation.sensor_noise_mm: got {self.sensor_noise_mm}, expected >= 0")


@dataclass(frozen=True)
class EnvConfig:
    """Simulation, reward and randomisation of `ReachEnv`."""

    engine: Literal["chain", "mjx"] = "chain"  # kinematics of the quasi-static mode
    mode: Literal["quasistatic", "dynamic"] = "quasistatic"  # equilibrium of each action, or its motion
    reward: RewardConfig = field(default_factory=RewardConfig)
    randomisation: Randomisation = field(default_factory=Randomisation)
    saturation_tolerance_mm: float = 1e3 * TOLERANCE_M
    """spring error at which a chamber at its limit counts as saturated"""
    n_poses: int = 8192  # poses of the reachable workspace that starts and goals are drawn from
    workspace_seed: int = 0  # seed of these poses
    dynamic_step_s: float = 0.5  # duration of one environment step in dynamic mode
    pipe_diameter_mm: float | None = None  # cross-shaped pipe around the arm, without contact
    clearance_cost_per_mm: float = 0.0  # reward lost per mm by which the clearance falls below the margin
    clearance_margin_mm: float = 10.0  # clearance of the body to the wall that costs nothing

    def __post_init__(self):
        for name, allowed in (("engine", ("chain", "mjx")), ("mode", ("quasistatic", "dynamic"))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"EnvConfig.{name}: got {getattr(self, name)!r}, expected one of {allowed}")
        if self.pipe_diameter_mm is not None:
            CrossPipe.of_mm(self.pipe_diameter_mm)  # raises
        elif self.clearance_cost_per_mm:
            raise ValueError(
                f"EnvConfig.clearance_cost_per_mm: got {self.clearance_cost_per_mm}, expected 0 without a "
                "pipe_diameter_mm"
            )
        if self.clearance_cost_per_mm < 0:
            raise ValueError(
                f"EnvConfig.clearance_cost_per_mm: got {self.clearance_cost_per_mm}, expected >= 0"
            )
        if self.n_poses < 1:
            raise ValueError(f"EnvConfig.n_poses: got {self.n_poses}, expected at least 1")
        if self.workspace_seed == HELD_OUT_SEED:
            raise ValueError(
                f"EnvConfig.workspace_seed: got {HELD_OUT_SEED}, expected another: "
                f"{HELD_OUT_SEED} draws the goals of the evaluation"
            )
