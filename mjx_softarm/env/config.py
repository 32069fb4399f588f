"""Settings of the environment: simulation, observation, reward and randomisation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Annotated, Literal, get_args

from tyro.conf import arg

from mjx_softarm._support.errors import check_settings
from mjx_softarm.control import TOLERANCE_M
from mjx_softarm.mdp.observation import Observation
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.mechanics.pipe import CrossPipe
from mjx_softarm.mechanics.workspace import HELD_OUT_SEED
from mjx_softarm.spec import ArmSpec

Engine = Literal["mjx", "chain", "mjx-step"]
ENGINES = {"quasistatic": ("mjx", "chain"), "dynamic": ("mjx", "mjx-step")}  # by mode


@dataclass(frozen=True)
class Randomisation:
    """Differences from episode to episode; with all at zero every arm is the nominal one."""

    payload_max_kg: float | None = None
    """the payload is uniform from the spec's to this much more; None: the arm's largest for a policy that
    observes the payload, else 0"""
    stiffness_spread: float = 0.0  # each chamber's stiffness is multiplied by 1 + uniform(-spread, spread)
    sensor_noise_mm: float = 0.0  # standard deviation of each spring's reading, fixed within an episode
    damping_spread: float = 0.0  # in motion, all dampers are multiplied by 1 + uniform(-spread, spread)
    delay_max_s: float = 0.0  # in motion, dead times are uniform from the actuators' to this much more
    regulator_spread: float = 0.0
    """in motion, lag, dead time and rates of regulators are multiplied by 1 + uniform(-spread, spread)"""
    friction_max_n: float = 0.0  # in motion, each chamber's dry friction is uniform from 0 to this

    def __post_init__(self):
        amounts = ("payload_max_kg", "sensor_noise_mm", "delay_max_s", "friction_max_n")
        shares = ("stiffness_spread", "damping_spread", "regulator_spread")
        required = {
            **{
                name: (0 <= (getattr(self, name) or 0.0) < math.inf, "a finite number >= 0")
                for name in amounts
            },
            **{name: (0 <= getattr(self, name) < 1, "0 to 1") for name in shares},
        }
        check_settings("Randomisation", self, required)


@dataclass(frozen=True)
class EnvConfig:
    """Simulation, reward and randomisation of `ReachEnv`."""

    engine: Annotated[Engine, arg(aliases=["--engine"])] = "mjx"
    """at rest, MJX's kinematics, tendons and forces at equilibria that the closed form proposes (mjx), or the
    closed form alone (chain); in motion, MJX's inertia in this project's own time step (mjx), or `mjx.step`
    of the compiled model (mjx-step)"""
    mode: Annotated[Literal["quasistatic", "dynamic"], arg(aliases=["--mode"])] = "quasistatic"
    """an action leads to its equilibrium, or moves the arm for a while"""
    links_per_section: int | None = None
    """links per section of the simulated arm; None: those of the specification"""
    observation: Observation = "pose"
    """pose and goal; payload: also the payload; motion: also springs, their rates, the tip's velocity and the
    last action, in dynamic mode"""
    goal_ends: bool = True  # a reached goal ends the episode; else it gives its reward in every step
    reward: RewardConfig = field(default_factory=RewardConfig)
    randomisation: Randomisation = field(default_factory=Randomisation)
    saturation_tolerance_mm: float = 1e3 * TOLERANCE_M
    """spring error at which a chamber at its limit counts as saturated"""
    n_poses: int = 8192  # poses of the reachable workspace that starts and goals are drawn from
    even_share: float = 0.0  # share of the poses that are uniform in volume, rim included
    workspace_seed: int = 0  # seed of the poses
    dynamic_step_s: float = 0.5  # duration of one environment step in dynamic mode
    simulation_step_s: float = 0.02
    """time step in dynamic mode, at most; no longer than a control period. By mjx-step, 0.002 is as exact as
    0.02 by mjx"""
    pipe_diameter_mm: Annotated[float | None, arg(aliases=["--pipe"])] = None
    """cross-shaped pipe around the arm"""
    clearance_cost_per_mm: float = 0.0  # cost per mm of clearance below the margin
    clearance_margin_mm: float = 10.0  # clearance of the body to the wall from which there is no cost

    @property
    def pipe(self) -> CrossPipe | None:
        """Pipe around the arm, if there is one."""
        return None if self.pipe_diameter_mm is None else CrossPipe.of_mm(self.pipe_diameter_mm)

    @property
    def moves(self) -> bool:
        """Whether the arm is in motion."""
        return self.mode == "dynamic"

    def arm(self, spec: ArmSpec, corrected: bool = False) -> ArmSpec:
        """Return the arm as it is simulated.

        Args:
            spec: the arm.
            corrected: whether it has a sim-to-real network, which holds for its own links alone.

        Raises:
            InputError: a corrected arm is to have other links, or an action is shorter than a control period.
        """
        period_s = 1.0 / spec.control.rate_hz
        links = spec.structure.links_per_section
        same = self.links_per_section in (None, links)
        required = {
            "dynamic_step_s": (self.dynamic_step_s >= period_s, f"{period_s:g} or more, a control period"),
            "links_per_section": (same or not corrected, f"{links}, as the sim-to-real network has"),
        }
        check_settings("EnvConfig", self, required)
        return spec if same else spec.replace(structure={"links_per_section": self.links_per_section})

    def __post_init__(self):
        # Names
        names = {"mode": tuple(ENGINES), "engine": get_args(Engine), "observation": get_args(Observation)}
        known = {
            name: (getattr(self, name) in allowed, f"one of {allowed}") for name, allowed in names.items()
        }
        check_settings("EnvConfig", self, known)

        # Which of them go together, and ranges of numbers
        engines = ENGINES[self.mode]
        observed = self.moves or self.observation != "motion"
        links = self.links_per_section
        other = f"another: {HELD_OUT_SEED} draws the goals of the evaluation"
        amount = "a finite number >= 0"
        required = {
            "engine": (self.engine in engines, f"one of {engines} with the mode {self.mode!r}"),
            "observation": (observed, "'pose' or 'payload' for arms at rest"),
            "dynamic_step_s": (0 < self.dynamic_step_s < math.inf, "a finite number > 0"),
            "simulation_step_s": (0 < self.simulation_step_s < math.inf, "a finite number > 0"),
            "saturation_tolerance_mm": (0 <= self.saturation_tolerance_mm < math.inf, amount),
            "clearance_margin_mm": (math.isfinite(self.clearance_margin_mm), "a finite number"),
            "n_poses": (self.n_poses >= 1, "at least 1"),
            "links_per_section": (links is None or links >= 1, "at least 1"),
            "even_share": (0 <= self.even_share <= 1, "0 to 1"),
            "workspace_seed": (self.workspace_seed != HELD_OUT_SEED, other),
            "clearance_cost_per_mm": (0 <= self.clearance_cost_per_mm < math.inf, amount),
        }
        check_settings("EnvConfig", self, required)
        costs = {item.name for item in fields(self.reward)} - {"axes"}
        axes = self.reward.axes
        usable = len(axes) == 6 and all(0 <= axis < math.inf for axis in axes) and any(self.reward.asked)
        required = {name: (0 <= getattr(self.reward, name) < math.inf, amount) for name in sorted(costs)}
        required["axes"] = usable, "six finite numbers >= 0, some more than 0"
        check_settings("RewardConfig", self.reward, required)

        # Settings of the pipe
        piped = self.pipe_diameter_mm is not None
        no_cost = piped or not self.clearance_cost_per_mm
        required = {"clearance_cost_per_mm": (no_cost, "0.0 without a pipe_diameter_mm")}
        check_settings("EnvConfig", self, required)
        if self.pipe_diameter_mm is not None:
            CrossPipe.of_mm(self.pipe_diameter_mm)  # raises ValueError
