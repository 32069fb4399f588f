"""What tests share: the paper's arm and its environment, built and compiled once."""

import jax
import pytest

from mjx_softarm import ArmSpec, xla
from mjx_softarm.env import EnvConfig, ReachEnv

N_ARMS = 512  # of every call of `reset` and `step`: another number would compile anew


@pytest.fixture(scope="session", autouse=True)
def compilation_cache():
    """Compile once per machine rather than once per run."""
    xla.enable_compilation_cache()


@pytest.fixture(scope="session")
def spec():
    return ArmSpec.default()


@pytest.fixture(scope="session")
def env(spec):
    """The paper's arm, quasi-static, chain engine, not randomised; as many poses as arms."""
    return ReachEnv(spec, EnvConfig(n_poses=N_ARMS))


@pytest.fixture(scope="session")
def reset(env):
    """Seed -> state of N_ARMS arms."""
    jitted = xla.jit(jax.vmap(env.reset), env.uses_mjx)
    return lambda seed: jitted(jax.random.split(jax.random.key(seed), N_ARMS))


@pytest.fixture(scope="session")
def step(env):
    """State and actions (N_ARMS, 9) -> state."""
    return xla.jit(jax.vmap(env.step), env.uses_mjx)


@pytest.fixture
def start(reset):
    """State of N_ARMS arms, always the same."""
    return reset(0)


@pytest.fixture(scope="session")
def random_actions(env):
    """Uniform in [-1, 1], (N_ARMS, 9): they saturate a chamber of nearly every arm."""
    return jax.random.uniform(jax.random.key(1), (N_ARMS, env.action_size), minval=-1.0)
