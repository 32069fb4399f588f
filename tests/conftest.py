"""Fixtures that tests share: the paper's arm and its environment, built and compiled once."""

import itertools
import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as many tests run at once as there are cores

import jax
import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm._support import xla
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.policy.file import ArmModel
from mjx_softarm.sensing.estimator import SpringModel
from mjx_softarm.sensing.load import LoadEstimator
from mjx_softarm.sensing.s2r import N_POSE_INPUTS, N_POSE_OUTPUTS
from tests.arms import OTHER_ARMS
from tests.linear_arm import even_estimator
from tests.networks import s2r_of

N_ARMS = 512  # in each call of `reset` and `step`: another number would compile anew


@pytest.fixture(scope="session", autouse=True)
def compilation_cache():
    """Compile once per machine rather than once per run."""
    xla.enable_compilation_cache()


@pytest.fixture(scope="module")
def quick_compiler():
    """Twice as fast to compile what runs for milliseconds."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(scope="module")
def strict():
    """Neither dtypes nor ranks are promoted."""
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield


@pytest.fixture(scope="session")
def spec():
    return ArmSpec.default()


@pytest.fixture(scope="session", params=OTHER_ARMS)
def other_arm(request):
    """Each of these three arms."""
    return OTHER_ARMS[request.param]


@pytest.fixture(scope="session")
def env(spec):
    """The paper's arm, quasi-static, chain engine, not randomised; as many poses as arms."""
    return ReachEnv(spec, EnvConfig(engine="chain", n_poses=N_ARMS))


@pytest.fixture(scope="session")
def reset(env):
    """Seed -> state of N_ARMS arms."""
    jitted = xla.jit(jax.vmap(env.reset))
    return lambda seed: jitted(jax.random.split(jax.random.key(seed), N_ARMS))


@pytest.fixture(scope="session")
def step(env):
    """State and actions (N_ARMS, 9) -> state."""
    return xla.jit(jax.vmap(env.step))


@pytest.fixture
def start(reset):
    """State of N_ARMS arms, always the same."""
    return reset(0)


@pytest.fixture(scope="session")
def random_actions(env):
    """Uniform in [-1, 1], (N_ARMS, 9): they saturate a chamber of nearly every arm."""
    return jax.random.uniform(jax.random.key(1), (N_ARMS, env.action_size), minval=-1.0)


@pytest.fixture(scope="session")
def make_arm_model():
    """Specification -> networks of a policy file, with random weights that change little."""

    def make(spec: ArmSpec, s2r: bool = False) -> ArmModel:
        rng, n, n_sections = np.random.default_rng(3), spec.n_springs, spec.structure.n_sections

        def layers(*sizes):
            pairs = itertools.pairwise(sizes)
            return tuple(
                (np.float32(0.01 * rng.normal(size=(a, b))), np.float32(0.01 * rng.normal(size=b)))
                for a, b in pairs
            )

        def row(value, size=n):
            return np.full(size, value, np.float32)

        angle = np.pi / 2 + 2 * np.pi * np.arange(n).reshape(n_sections, -1) / spec.springs_per_section
        site_m = np.float32(0.067 * np.stack([np.cos(angle), np.sin(angle)], -1))
        kg, estimator = np.float32([0.0, 1.0]), even_estimator(site_m)
        coefficient = 1e-3 * rng.normal(size=estimator.coefficient.shape)
        estimator = estimator._replace(coefficient=np.float32(coefficient))
        scaling, kpa = (row(0.18), row(0.05)), (row(-10.0, spec.n_chambers), row(30.0, spec.n_chambers))
        n_out, blocks = 2 * spec.n_chambers + n_sections, (n_sections, spec.n_chambers // n_sections)
        plane = np.float32(0.1 * rng.normal(size=(n, n_out))), *scaling, row(-4.0, n_out), row(1.0, n_out)
        known = np.float32(np.tile(np.eye(blocks[1]), (n_sections, 1, 1)))
        hysteresis = row(0.7, spec.n_chambers), row(0.01, spec.n_chambers)
        held = known, 0.1 * known, *hysteresis, *kg, np.float32(0.05)
        load = LoadEstimator(layers(n, 4, n_out), *plane, *held)
        springs = SpringModel(layers(spec.n_chambers, 5, n), *kpa, *scaling)
        poses = np.float32([[0, 0, -600, 0, 0, 0], [80, 0, -575, 0, 0, 0], [0, 100, -500, 10, 40, -30]])
        n_in = N_POSE_INPUTS + n
        network, anchors = layers(n_in, 6, N_POSE_OUTPUTS), np.float32(rng.normal(size=(4, n_in)))
        s2r_network = s2r_of(network, 5.0, anchors=anchors, limit=np.float32(0.3))
        return ArmModel(poses, estimator, load, springs, s2r_network if s2r else None)

    return make
