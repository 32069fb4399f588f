"""A linear arm whose every answer is known, a policy that is exact for it, and the loop that drives it."""

import dataclasses

import jax
import numpy as np

from mjx_softarm import ArmSpec
from mjx_softarm.control import Gains
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.session import follow
from mjx_softarm.mdp.actions import ActionMap
from mjx_softarm.mdp.observation import ObsScale
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.policy.file import Policy
from mjx_softarm.sensing.estimator import (
    N_CHANGES,
    N_TERMS,
    N_VARIABLES,
    PoseEstimator,
    SpringModel,
    estimate,
    polynomial_terms,
)
from mjx_softarm.sensing.load import COMMON_FACTOR, LoadEstimator

SPEC = ArmSpec.default()
N, DT_S = SPEC.n_chambers, 1.0 / SPEC.control.rate_hz
SENSOR = SPEC.spring_sensor
LOW_KPA, HIGH_KPA = SPEC.chambers.pressure_min_kpa, SPEC.chambers.pressure_max_kpa
REST_M = 0.2
NOISE_M = 4e-5
VARIABLE_RANGE = 10.0  # of the estimator: nothing is beyond it
LENGTH, LOAD = 0, N_VARIABLES - 1  # places of two of its variables
LAG = 0.15  # of the way to the commanded pressure, per tick


def gain_of(spec):
    """Lengths of springs per pressure (n_springs, n_chambers) [m/kPa].

    A chamber lengthens the springs beside it and, by bending, shortens its section's others.
    """
    n = spec.structure.chambers_per_section
    angle = 2 * np.pi * np.arange(n) / n
    near = np.cos(angle[:: n // spec.springs_per_section, None] - angle)
    return np.kron(np.eye(spec.structure.n_sections), 3 / n * (3e-4 + 1.2e-3 * near))


GAIN_M_PER_KPA = gain_of(SPEC)


class LinearArm:
    """Springs that follow the pressures linearly, with a lag, on a clock of its own."""

    def __init__(self, noise_m=NOISE_M, sensor=None, spec=SPEC):
        self.time_s, self.noise_m, self.sensor = 0.0, noise_m, sensor or spec.spring_sensor
        self.command_kpa = self.actual_kpa = np.zeros(spec.n_chambers)
        self.written = []
        self._rng = np.random.default_rng(0)
        self._rest_m, self._gain = spec.at_springs(spec.geometry.section_length_m), gain_of(spec)

    @property
    def spring_m(self):
        return self._rest_m + self._gain @ self.actual_kpa

    @property
    def tick(self):
        return round(self.time_s / DT_S)

    def read_sensors(self):
        return self.sensor.readings(
            self.spring_m + self.noise_m * self._rng.standard_normal(len(self._rest_m))
        )

    def write_pressures(self, pressure_kpa):
        self.command_kpa = np.array(pressure_kpa)
        self.written.append(self.command_kpa)
        self.actual_kpa = self.actual_kpa + LAG * (self.holds(self.command_kpa) - self.actual_kpa)
        self.time_s += DT_S

    def holds(self, pressure_kpa):
        return pressure_kpa


class Leaking(LinearArm):
    """A chamber falls to atmospheric pressure."""

    def __init__(self, tick, spec=SPEC):
        super().__init__(spec=spec)
        self.leaks_from = tick

    def holds(self, pressure_kpa):
        leaks = (np.arange(len(pressure_kpa)) == 3) & (self.tick >= self.leaks_from)
        return np.where(leaks, 0.0, pressure_kpa)


class Blind(LinearArm):
    """Readings go wrong in some ticks."""

    def __init__(self, ticks, spoil):
        super().__init__()
        self._ticks, self._spoil = ticks, spoil

    def read_sensors(self):
        readings = super().read_sensors()
        return self._spoil(readings) if self.tick in self._ticks else readings


def nan(readings):
    return np.where(np.arange(N) == 4, np.nan, readings)


def load_estimator_of(spec, effect_kpa_per_kg, sd_kg=0.05):
    """An estimator that is exact for the linear arm, where a payload has this effect on the chambers."""
    n, n_sections, c = spec.n_springs, spec.structure.n_sections, spec.structure.chambers_per_section
    effect, slope = np.asarray(effect_kpa_per_kg, float), np.linalg.pinv(gain_of(spec)).T
    n_out, shares = 2 * spec.n_chambers + n_sections, np.zeros(n_sections)
    covariance = np.tile(sd_kg**2 * (effect**2).sum() * np.eye(c), (n_sections, 1, 1))
    estimator = LoadEstimator(
        layers=((np.zeros((n, n_out)), np.zeros(n_out)),),
        slope=np.concatenate([slope, np.zeros((n, n_out - spec.n_chambers))], axis=1),
        spring_centre_m=spec.at_springs(spec.geometry.section_length_m),
        spring_scale_m=np.ones(n),
        out_centre=np.concatenate([np.zeros(spec.n_chambers), effect, shares]),
        out_scale=np.ones(n_out),
        covariance_kpa2=covariance,
        error_kpa2=0.0 * covariance,
        hysteresis_kpa=np.zeros(spec.n_chambers),
        stroke_m=np.ones(spec.n_chambers),
        own_load_kg=0.0,
        load_scale_kg=1.0,
        factor_sd=COMMON_FACTOR,
    )
    return jax.tree.map(np.float32, estimator)


def even_estimator(site_m):
    """An estimator of sections that bend evenly, with springs in holes (n_sections, s, 2) [m]."""
    n_sections = len(site_m)
    estimator = PoseEstimator(
        coefficient=np.zeros((n_sections, N_TERMS, N_CHANGES)),
        variable_centre=np.zeros((n_sections, N_VARIABLES)),
        variable_scale=np.full((n_sections, N_VARIABLES), VARIABLE_RANGE),
        spring_site_m=site_m,
        section_mass_kg=np.full(n_sections, 0.1),
        gripper_mass_kg=0.1,
        tool_offset_m=np.array([0.05, 0.1]),
        base_position_m=np.zeros(3),
        base_rotation=np.eye(3),
        tip_offset_m=np.zeros(3),
        tip_rotation=np.eye(3),
    )
    return jax.tree.map(np.float32, estimator)


def changed(estimator, change, factors=(), sections=slice(None)):
    """The estimator whose sections' ends change (N_CHANGES,) for each product of 1 of these variables."""
    coefficient = estimator.coefficient.copy()
    primes = np.array([2.0, 3, 5, 7, 11, 13, 17, 19, 23, 29])  # a product of them has one place
    [term] = np.flatnonzero(polynomial_terms(primes) == np.prod(primes[list(factors)]))
    coefficient[sections, term] += np.multiply(change, VARIABLE_RANGE ** len(factors))
    return estimator._replace(coefficient=coefficient.astype(estimator.coefficient.dtype))


def make_policy(spec=SPEC):
    """A policy whose estimator and spring model are exact for the linear arm; its actor is not looked at."""
    n, n_sections = spec.n_springs, spec.structure.n_sections
    rest_m, gain = spec.at_springs(spec.geometry.section_length_m), gain_of(spec)
    first_rad = np.radians(spec.per_section(spec.geometry.first_chamber_deg))
    angle = first_rad[:, None] + 2 * np.pi * np.arange(n // n_sections) * n_sections / n
    radius_m = np.array(spec.per_section(spec.geometry.spring_radius_m))
    site_m = radius_m[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    network = even_estimator(site_m)
    load = load_estimator_of(spec, np.full(spec.n_chambers, 1e5))  # no pressure counts as a payload
    model = SpringModel(
        layers=((gain.T, np.zeros(n)),),
        pressure_centre_kpa=np.zeros(spec.n_chambers),
        pressure_scale_kpa=np.ones(spec.n_chambers),
        spring_centre_m=rest_m,
        spring_scale_m=np.ones(n),
    )
    rng = np.random.default_rng(1)
    return Policy(
        layers=((np.zeros((18, n), np.float32), np.zeros(n, np.float32)),),
        obs_scale=ObsScale(*(np.asarray(value, float) for value in ObsScale.from_spec(spec))),
        reward=RewardConfig(),
        actions=ActionMap.from_spec(spec),
        gains=Gains.from_spec(spec),
        rate_hz=spec.control.rate_hz,
        spec=spec,
        workspace=estimate(network, rest_m + rng.uniform(-30, 15, (2000, spec.n_chambers)) @ gain.T, 0.0),
        estimator=network,
        load_estimator=load,
        spring_model=jax.tree.map(np.float32, model),
        s2r=None,
        provenance={},
    )


def moves_aside(policy):
    """A policy whose tip moves aside, twice as far with 1 kg, as its last spring gets longer."""
    aside = np.array([1.5, 0, 0, 0, 0, 0])
    estimator = changed(policy.estimator, aside, (LENGTH,), sections=slice(-1, None))
    estimator = changed(estimator, aside, (LENGTH, LOAD), sections=slice(-1, None))
    return dataclasses.replace(policy, estimator=estimator)


POLICY = make_policy()
PRESSURES_KPA = np.random.default_rng(2).uniform(-20, 10, (2, N))
SPRINGS_M = REST_M + PRESSURES_KPA @ GAIN_M_PER_KPA.T
GOALS = estimate(POLICY.estimator, SPRINGS_M, 0.0).astype(float)
FAR = GOALS[0] + [0.0, 0.0, -400.0, 0.0, 0.0, 0.0]


def exact_plan(pose, goal, spring_m, sensed):
    """The springs of the goal."""
    return SPRINGS_M[int(np.argmin(np.abs(GOALS - goal).sum(axis=1)))]


def between(pose, goal, spring_m, sensed):
    """The springs in between the goals' for a goal in between."""
    share = np.linalg.norm(goal - GOALS[0]) / np.linalg.norm(GOALS[1] - GOALS[0])
    return SPRINGS_M[0] + share * (SPRINGS_M[1] - SPRINGS_M[0])


def asking(plan, arm=None):
    """A plan, and what it was asked in each action: pose, goal, springs, `sensed`, tick of an arm."""
    asked = []

    def ask(*at):
        asked.append((*at, arm and arm.tick))
        return plan(*at)

    return ask, asked


CONTROLLER = Controller.of(POLICY, exact_plan)


def go(arm, goals=GOALS, controller=CONTROLLER, **kwargs):
    return follow(arm, controller, goals, **kwargs)


def read_m(log):
    """Spring lengths (rows, 9) [m] by the logged frequencies, NaN where a reading was lost."""
    return SENSOR.lengths(log.readings, np.nan).length_m
