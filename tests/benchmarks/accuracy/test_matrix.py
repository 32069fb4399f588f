"""Every simulation against every other: which simulations a policy is tried in, and what is told of them."""

import json
from types import SimpleNamespace

import jax
import pytest

from benchmarks.accuracy import matrix
from benchmarks.accuracy.matrix import SIMULATIONS, in_simulations, means, on_arm, targets, trained_in
from mjx_softarm import ArmSpec
from mjx_softarm._support.errors import InputError
from mjx_softarm.env import EnvConfig, ReachEnv
from train.agent.registry import World, learner_of
from train.config import TrainConfig


def test_what_cannot_be_measured_is_refused_before_anything_is(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="--runs: got none, expected ARM=RUN of each"):
        matrix.measure(())
    with pytest.raises(InputError, match="--runs: got the engine warp, expected chain or mjx"):
        trained_in(EnvConfig(mode="dynamic", engine="warp"))
    with pytest.raises(InputError, match="--runs: got the arm soromoxx, expected twin:SEED"):
        matrix.kind_of("soromoxx")
    monkeypatch.setattr(matrix.Run, "open", lambda folder: None)
    with pytest.raises(InputError, match="got no policy.npz, expected an exported run"):
        matrix.opened(tmp_path)


@pytest.mark.parametrize("name", SIMULATIONS)
def test_a_run_is_named_after_its_simulation(name):
    settings = SIMULATIONS[name] | {"simulation_step_s": 0.01}
    assert trained_in(EnvConfig(**settings)) == name


def test_an_untrained_policy_is_as_far_off_in_both_simulations_at_rest(monkeypatch):
    two = dict(list(SIMULATIONS.items())[:2])
    monkeypatch.setattr(matrix, "SIMULATIONS", two)
    monkeypatch.setattr(matrix, "N_POSES", 8)
    spec = ArmSpec.default().replace(structure={"links_per_section": 1})
    config = TrainConfig()
    learner = learner_of(config.learner, World(ReachEnv(spec, config.env), None, None))
    state = learner.init(jax.random.PRNGKey(0))
    run = SimpleNamespace(
        config=config,
        spec=spec,
        arm=SimpleNamespace(s2r=None),
        policy=lambda: learner.policy(state),
    )
    found = in_simulations(run, 2)
    assert list(found) == list(two)
    chain, mjx = found.values()
    assert chain > 1.0 and chain == pytest.approx(mjx, abs=0.01)


def test_a_policy_of_motion_is_not_tried_at_rest(monkeypatch):
    monkeypatch.setattr(matrix, "SIMULATIONS", {"chain, at rest": SIMULATIONS["chain, at rest"]})
    env = EnvConfig(mode="dynamic", observation="motion")
    run = SimpleNamespace(config=SimpleNamespace(env=env), policy=lambda: None)
    assert in_simulations(run, 2) == {"chain, at rest": None}


@pytest.mark.parametrize(
    "arm, kind, asked",
    [
        ("twin:1", "C MuJoCo twin", "twin:1"),
        ("twin:rod:1", "rod", "twin:rod:1"),
        ("soromox", "SoRoMoX", "benchmarks.accuracy.soromox_arm:Arm"),
    ],
)
def test_each_arm_has_its_column(tmp_path, monkeypatch, arm, kind, asked):
    def accuracy_of(policy, name, out, *options, python):
        assert policy == tmp_path / "policy.npz" and name == asked
        assert str(python).endswith("peer") == (arm == "soromox")
        return {"translation_mm": 1.5, "measured": measured}

    measured = 4
    monkeypatch.setattr(matrix, "accuracy_of", accuracy_of)
    monkeypatch.setattr("benchmarks.accuracy.arms.peer_python", lambda name: "peer")
    assert matrix.kind_of(arm) == kind
    assert on_arm(SimpleNamespace(path=tmp_path), arm, 4) == 1.5
    measured = 3
    with pytest.raises(InputError, match="got 3 of 4 goals, expected all"):
        on_arm(SimpleNamespace(path=tmp_path), arm, 4)


def test_targets_compare_means_with_that_of_the_training():
    rows = [
        {"trained in": "chain, at rest", "arm": "a", "chain, at rest": 0.2, "MJX, at rest": 0.3, "rod": None},
        {"trained in": "chain, at rest", "arm": "b", "chain, at rest": 0.4, "MJX, at rest": 0.3, "rod": 0.7},
    ]
    (mean,) = means(rows)
    assert mean["runs"] == 2 and mean["chain, at rest"] == pytest.approx(0.3) and mean["rod"] == 0.7
    assert [(row["measured"], row["verdict"]) for row in targets(rows)] == [
        ("0.30 and 0.30 mm", "met"),
        ("0.70 and 0.40 mm", "met"),  # of the second run alone
    ]


def test_soromox_s_worker_is_asked_for_distances(monkeypatch):
    monkeypatch.setattr("benchmarks.accuracy.arms.peer_python", lambda name: "peer")
    told = SimpleNamespace(returncode=0, stdout=json.dumps({"apart_mm": [0.5, 0.1]}))
    monkeypatch.setattr(matrix.subprocess, "run", lambda command, **rest: told)
    assert matrix.beside_soromox() == {"poses": 2, "mean [mm]": 0.3, "largest [mm]": 0.5}
    told.returncode = 1
    with pytest.raises(InputError, match="soromox_arm 0 20: got exit status 1, expected 0"):
        matrix.beside_soromox()
