"""Policies with every part at work, their files and their golden rows."""

import contextlib
import dataclasses
import hashlib
import itertools

import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.export import golden as golden_rows
from mjx_softarm.mdp.observation import layouts
from mjx_softarm.policy.file import load_policy, save_policy
from mjx_softarm.sensing.s2r import N_POSE_INPUTS, N_POSE_OUTPUTS
from tests.linear_arm import SPEC, N, load_estimator_of, make_policy
from tests.networks import s2r_of


def layers(*sizes, scale):
    rng = np.random.default_rng(5)
    pairs = itertools.pairwise(sizes)
    return tuple(
        (np.float32(scale * rng.normal(size=(a, b))), np.float32(0.1 * rng.normal(size=b))) for a, b in pairs
    )


def busy_policy(spec=SPEC):
    """The linear arm's policy with an actor, an estimator and a sim-to-real network that change much."""
    policy, n = make_policy(spec), spec.n_springs
    n_in = N_POSE_INPUTS + n
    anchors = np.float32(np.random.default_rng(6).normal(0.0, 0.1, (5, n_in)))
    network, bound = layers(n_in, 8, N_POSE_OUTPUTS, scale=0.3), np.repeat([9.0, 0.1], 3)
    s2r = s2r_of(network, bound, anchors=anchors, limit=np.float32(0.335))
    sizes = policy.estimator.coefficient.shape
    coefficient = 0.001 * np.random.default_rng(7).normal(size=sizes)
    mounting = {"tip_offset_m": [0.01, 0.0, -0.02], "base_position_m": [0.0, 0.02, 0.01]}
    estimator = policy.estimator._replace(
        coefficient=np.float32(coefficient),
        variable_scale=np.full_like(policy.estimator.variable_scale, 0.7),
        **{name: np.float32(value) for name, value in mounting.items()},
    )
    # 1 kPa less in every chamber than its springs show is half a kilogram
    load = load_estimator_of(spec, np.full(spec.n_chambers, -2.0))
    hysteresis = np.full(spec.n_chambers, 0.1, np.float32), np.full(spec.n_chambers, 0.01, np.float32)
    load = load._replace(hysteresis_kpa=hysteresis[0], stroke_m=hysteresis[1])
    networks = {"estimator": estimator, "load_estimator": load, "s2r": s2r}
    return dataclasses.replace(policy, layers=layers(18, 12, n, scale=0.5), **networks)


def draw_wire_policy():
    """A busy policy of an arm with draw wires, without a sim-to-real network."""
    spec = SPEC.to_dict()
    spec["sensor"] = {"kind": "draw_wire", "m_per_v": 0.1, "voltage_min_v": 0.0, "voltage_max_v": 5.0}
    spec["sensor"] |= {"beta": 1.0, "delta_m": 0.01}
    return dataclasses.replace(busy_policy(ArmSpec.from_dict(spec, "test")), s2r=None)


def moving_policy(spec=SPEC):
    """A busy policy that acts each 0.3 s on what it sees of the motion."""
    actor = layers(len(layouts(spec)["motion"]), 12, spec.n_springs, scale=0.3)
    return dataclasses.replace(busy_policy(spec), layers=actor, observation="motion", action_s=0.3)


def carrying_policy(spec=SPEC):
    """A busy policy that observes the payload."""
    actor = layers(len(layouts(spec)["payload"]), 12, spec.n_springs, scale=0.5)
    changes = {"layers": actor, "activation": "swish", "observation": "payload"}
    return dataclasses.replace(busy_policy(spec), **changes)


N_SINGLE = 200  # single rows of the fixture `golden`, a fifth of an export's


@contextlib.contextmanager
def few_golden_rows(run_ticks=30, n_single=40, n_checked=4, n_candidates=30):
    """Golden rows made in here are few; runs end after so many ticks."""
    numbers = {"N_SINGLE": n_single, "N_CHECKED": n_checked, "_CANDIDATES": n_candidates}
    with pytest.MonkeyPatch.context() as patch:
        for name, number in (numbers | {"_RUN_TICKS": run_ticks}).items():
            patch.setattr(golden_rows, name, number)
        yield


@pytest.fixture(scope="session")
def policy_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "policy.npz"
    beta = tuple(np.linspace(0.9, 0.98, N))
    save_policy(path, busy_policy(SPEC.replace(sensor={"beta": beta})))
    return path


@pytest.fixture(scope="session")
def controller(policy_file):
    return Controller.of(load_policy(policy_file))


@pytest.fixture(scope="session")
def golden(controller, policy_file):
    """Rows of all kinds and faults, fewer than an export has; the runs are as long."""
    sha256 = hashlib.sha256(policy_file.read_bytes()).hexdigest()
    with few_golden_rows(golden_rows._RUN_TICKS, N_SINGLE, n_checked=24, n_candidates=110):
        return golden_rows.make_golden(controller, sha256)
