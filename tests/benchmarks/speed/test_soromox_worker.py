"""The worker of SoRoMoX: the same arm as the project's, forces of pressures, steps of a known robot."""

import json
import subprocess
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.harness.rounds import ROOT
from benchmarks.speed.soromox_worker import N_STEPS, random_forces, section_matrices, stepper
from mjx_softarm import ArmSpec

SPEC = ArmSpec.default()
PYTHON = ROOT / ".venv-soromox" / "bin" / "python"


def test_a_section_has_the_stiffness_that_the_specification_gives_by_hand():
    strains = np.diag(section_matrices(SPEC, "stiffness")[0]) / 0.2**2
    np.testing.assert_allclose(strains[3], 3 * (506.7 + 54.0) + 851.4)  # stretch
    np.testing.assert_allclose(strains[1], 1.5 * (506.7 * 0.035**2 + 54.0 * 0.067**2) + 1.0814)  # bending
    damping = np.diag(section_matrices(SPEC, "damping")[0]) / 0.2**2
    np.testing.assert_allclose(damping[3], 3 * (20.0 + 30.0) + 20.0)
    np.testing.assert_allclose(damping[1], 1.5 * (20.0 * 0.035**2 + 30.0 * 0.067**2) + 1.0)


def test_equal_pressures_stretch_and_one_chamber_bends_away_from_its_side():
    class Fixed:
        def uniform(self, low, high, shape):
            pressure = np.full(shape, high)
            pressure[:, 1, 1:] = 0.0  # only the first chamber of the second section
            return pressure

    (force,) = random_forces(SPEC, 1, Fixed())
    sections = force.reshape(3, 3) / 0.2
    push_n = 20e3 * 1.62e-3
    np.testing.assert_allclose(sections[0], [0.0, 0.0, 3 * push_n], atol=1e-12)
    np.testing.assert_allclose(sections[1], [0.035 * push_n, 0.0, push_n], atol=1e-12)  # at 90 deg


def pendulum(inertia, damping, stiffness):
    """A robot of one linear strain, with a weight of 1."""
    matrices = [jnp.array([[x]]) for x in (inertia, damping, stiffness)]

    def forward_dynamics(t, state, actuation):
        q, v = state[:1], state[1:]
        force = actuation[0] - 1.0 - matrices[2] @ q - matrices[1] @ v
        return jnp.concatenate([v, force / inertia])

    return SimpleNamespace(
        forward_dynamics=forward_dynamics,
        dynamics_terms=lambda q, v: (matrices[0], jnp.zeros(1), jnp.ones(1)),
        damping_matrix=lambda q: matrices[1],
        stiffness_matrix=lambda: matrices[2],
    )


@pytest.mark.parametrize("method, tolerance", [("explicit", 0.03), ("implicit", 1e-3)])
def test_a_step_follows_an_oscillator(method, tolerance):
    robot, state, n = pendulum(2.0, 0.0, 8.0), jnp.array([0.5, 0.0]), 200
    step = jax.jit(stepper(robot, method, 0.5 / n))
    for _ in range(n):
        state = step(state, jnp.array([1.0]))  # it balances the weight
    exact = np.array([0.5 * np.cos(1.0), -1.0 * np.sin(1.0)])  # angular rate 2 over 0.5 s
    np.testing.assert_allclose(state, exact, atol=tolerance)


def test_the_implicit_step_rests_where_an_explicit_one_diverges():
    robot = pendulum(1e-3, 2.0, 10.0)  # decays 2,000 times a second
    ends = {}
    for method in N_STEPS:
        step, state = jax.jit(stepper(robot, method, 0.02)), jnp.zeros(2)
        for _ in range(1000):
            state = step(state, jnp.array([6.0]))
        ends[method] = np.asarray(state)
    np.testing.assert_allclose(ends["implicit"][0], 0.5, atol=1e-3)
    assert not np.isfinite(ends["explicit"]).all()


@pytest.mark.skipif(not PYTHON.exists(), reason="the environment of SoRoMoX is not made")
def test_the_weight_stretches_the_straight_arm_and_does_not_bend_it():
    lines = (
        "import json, numpy",
        "from benchmarks.speed.soromox_worker import build_robot",
        "from mjx_softarm.spec import ArmSpec",
        "robot = build_robot(ArmSpec.default())",
        "print(json.dumps(robot.gravitational_force(numpy.zeros(robot.num_coordinates)).tolist()))",
    )
    done = subprocess.run([PYTHON, "-c", "; ".join(lines)], cwd=ROOT, check=True, capture_output=True)
    bend_y, bend_z, stretch = np.reshape(json.loads(done.stdout), (-1, 3)).T
    np.testing.assert_allclose([bend_y, bend_z], 0.0, atol=1e-6)
    assert (stretch < -1.0).all()  # the derivative of the weight's energy
