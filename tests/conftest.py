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
from mjx_softarm.sensing.s2r import N_POSE_INPUTS, N_POSE_OUTPUTS
from tests.arms import OTHER_ARMS
from tests.linear_arm import make_policy
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
        rng, policy = np.random.default_rng(3), make_policy(spec)
        estimator, load, springs = policy.estimator, policy.load_estimator, policy.spring_model

        def small(*shape):
            return np.float32(0.01 * rng.normal(size=shape))

        def layers(*sizes):
            return tuple((small(n_in, n_out), small(n_out)) for n_in, n_out in itertools.pairwise(sizes))

        n_in = N_POSE_INPUTS + spec.n_springs
        network = layers(n_in, 6, N_POSE_OUTPUTS)
        anchors = np.float32(rng.normal(size=(4, n_in)))
        return ArmModel(
            workspace=policy.workspace[:3],
            estimator=estimator._replace(coefficient=0.1 * small(*estimator.coefficient.shape)),
            load_estimator=load._replace(layers=layers(spec.n_springs, 4, len(load.out_scale))),
            spring_model=springs._replace(layers=layers(spec.n_chambers, 5, spec.n_springs)),
            s2r=s2r_of(network, 5.0, anchors=anchors, limit=np.float32(0.3)) if s2r else None,
        )

    return make
