"""Settings of the environment: simulation, observation, reward and randomisation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

from tyro.conf import arg

from mjx_softarm._support.errors import check_settings
from mjx_softarm._support.fields import Amount, Count, PartialShare, Positive, Share, check_ranges
from mjx_softarm.mdp.observation import Observation
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.mechanics.pipe import CrossPipe
from mjx_softarm.posture import hangs
from mjx_softarm.spec import ArmSpec

Engine = Literal["mjx", "chain", "mjx-step"]
ENGINES = {"quasistatic": ("mjx", "chain"), "dynamic": ("mjx", "mjx-step")}  # by mode


@dataclass(frozen=True)
class Randomisation:
    """Differences from episode to episode; with all at zero every arm is the nominal one."""

    payload_max_kg: Amount | None = None
    """the payload is uniform from the spec's to this much more; None: the arm's largest for a policy that
    observes the payload, else 0"""
    stiffness_spread: PartialShare = 0.0
    """each chamber's stiffness is multiplied by 1 + uniform(-spread, spread)"""
    damping_spread: PartialShare = 0.0
    """in motion, all dampers are multiplied by 1 + uniform(-spread, spread)"""
    delay_max_s: Amount = 0.0  # in motion, dead times are uniform from the actuators' to this much more
    regulator_spread: PartialShare = 0.0
    """in motion, lag, dead time and rates of regulators are multiplied by 1 + uniform(-spread, spread)"""
    friction_max_n: Amount = 0.0  # in motion, each chamber's dry friction is uniform from 0 to this

    def __post_init__(self):
        check_ranges("Randomisation.", self)


@dataclass(frozen=True)
class EnvConfig:
    """Simulation, reward and randomisation of `ReachEnv`."""

    engine: Annotated[Engine, arg(aliases=["--engine"])] = "mjx"
    """at rest, MJX's kinematics, tendons and forces at equilibria that the closed form proposes (mjx), or the
    closed form alone (chain); in motion, MJX's inertia in this project's own time step (mjx), or `mjx.step`
    of the compiled model (mjx-step)"""
    mode: Annotated[Literal["quasistatic", "dynamic"], arg(aliases=["--mode"])] = "quasistatic"
    """an action leads to its equilibrium, or moves the arm for a while"""
    links_per_section: Count | None = None
    """links per section of the simulated arm; None: those of the specification"""
    observation: Observation = "pose"
    """pose and goal; payload: also the payload; motion: also springs, their rates, the tip's velocity and the
    last action, in dynamic mode"""
    goal_ends: bool = True  # a reached goal ends the episode; else it gives its reward in every step
    reward: RewardConfig = field(default_factory=RewardConfig)
    randomisation: Randomisation = field(default_factory=Randomisation)
    n_poses: Count = 8192  # poses of the reachable workspace that starts and goals are drawn from
    even_share: Share = 0.0  # share of the poses that are uniform in volume, rim included
    dynamic_step_s: Positive = 0.5  # duration of one environment step in dynamic mode
    simulation_step_s: Positive = 0.02
    """time step in dynamic mode, at most; no longer than a control period. By mjx-step, 0.002 is as exact as
    0.02 by mjx"""
    pipe_diameter_mm: Annotated[float | None, arg(aliases=["--pipe"])] = None
    """cross-shaped pipe around the arm"""
    clearance_cost_per_mm: Amount = 0.0  # cost per mm of the body's clearance to the wall below 10 mm

    @property
    def pipe(self) -> CrossPipe | None:
        """Pipe around the arm, if there is one."""
        return None if self.pipe_diameter_mm is None else CrossPipe(self.pipe_diameter_mm)

    @property
    def in_motion(self) -> bool:
        return self.mode == "dynamic"

    def arm(self, spec: ArmSpec, corrected: bool = False) -> ArmSpec:
        """Return the arm as it is simulated; a sim-to-real network (`corrected`) holds for its own links.

        Raises:
            InputError: a corrected arm is to have other links, an action is shorter than a control period, or
                an arm that does not hang is to enter a pipe.
        """
        period_s = 1.0 / spec.control.rate_hz
        links = spec.structure.links_per_section
        same = self.links_per_section in (None, links)
        required = {
            "dynamic_step_s": (self.dynamic_step_s >= period_s, f"{period_s:g} or more, a control period"),
            "links_per_section": (same or not corrected, f"{links}, as the sim-to-real network has"),
            "pipe_diameter_mm": (
                self.pipe is None or hangs(spec),
                f"None, as {spec.name!r} does not hang, and pipes are entered from above",
            ),
        }
        check_settings("EnvConfig", self, required)
        return spec if same else spec.replace(structure={"links_per_section": self.links_per_section})

    def __post_init__(self):
        # Ranges and names
        check_ranges("EnvConfig.", self)
        check_ranges("RewardConfig.", self.reward)
        axes = self.reward.axes
        usable = len(axes) == 6 and all(0 <= axis < math.inf for axis in axes) and any(self.reward.asked)
        required = {"axes": (usable, "six finite numbers >= 0, some more than 0")}
        check_settings("RewardConfig", self.reward, required)

        # Settings that go together
        engines = ENGINES[self.mode]
        observed = self.in_motion or self.observation != "motion"
        no_cost = self.pipe_diameter_mm is not None or not self.clearance_cost_per_mm
        required = {
            "engine": (self.engine in engines, f"one of {engines} with the mode {self.mode!r}"),
            "observation": (observed, "'pose' or 'payload' for arms at rest"),
            "clearance_cost_per_mm": (no_cost, "0.0 without a pipe_diameter_mm"),
        }
        check_settings("EnvConfig", self, required)
        if self.pipe_diameter_mm is not None:
            CrossPipe(self.pipe_diameter_mm)  # raises ValueError
