"""The stages' functions: what each asks of the command line, what it resumes, and the scene of a trial."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.paper import jobs, scene
from benchmarks.paper.engine import SMOKE, load_arrays
from benchmarks.paper.kinds import KINDS, Trial, learned_run, reach_run
from benchmarks.paper.measure import TrialOutcome
from mjx_softarm._support import cli
from mjx_softarm.mechanics.excitation import circle_poses
from mjx_softarm.mechanics.pipe import CrossPipe
from mjx_softarm.policy.file import save_policy
from mjx_softarm.policy.runtime import PolicyRunner
from mjx_softarm.spec import ARM_FILE
from mjx_softarm.twin.rod_twin import RodTwin
from tests.benchmarks.paper.made_up import SPEC, TINY, N, goals_of, make_policy, pipe_trial
from train.__main__ import COMMANDS
from train.presets import PRESETS


@pytest.fixture
def commands(monkeypatch):
    """A function: job and its arguments -> the commands that it ran."""
    calls = []
    monkeypatch.setattr(jobs, "command", lambda log, *arguments: calls.append(arguments))

    def run(job, *arguments):
        calls.clear()
        job(*arguments)
        return list(calls)

    return run


def parsed(arguments):
    """Return the command with its options; an unknown one ends the test."""
    return cli.read("train", COMMANDS, arguments)[1]


def test_training_starts_or_resumes_and_an_arm_s_policies_are_exported_at_once(tmp_path, commands):
    settings = dataclasses.replace(TINY, preset="quick", training=("learner.gamma=0.9",))
    run, work = tmp_path / reach_run(1, 2), (jobs.train_reach, tmp_path, settings, 1, 2)
    (start,) = commands(*work)
    options = parsed(start)
    assert (options.preset, options.config.seed, options.out) == ("quick", 2, run)
    assert options.calibration == tmp_path / "twin1" / "calibration"
    assert options.config.learner.gamma == 0.9
    run.mkdir()
    (run / "config.json").touch()
    (resume,) = commands(*work)
    assert parsed(resume).resume == run
    exports = jobs.export, tmp_path, settings, 1, (reach_run(1, 2), reach_run(1, 3))
    assert parsed(commands(*exports)[0]).keywords["folders"] == (run, tmp_path / reach_run(1, 3))
    (run / "policy.npz").touch()
    assert parsed(commands(*exports)[0]).keywords["folders"] == (tmp_path / reach_run(1, 3),)


def test_further_policies_have_a_preset_of_their_own_or_no_network(tmp_path, commands):
    settings = dataclasses.replace(TINY, preset="analytic", training=("env.n_poses=64",))
    calibration = tmp_path / "twin1" / "calibration"
    (start,) = commands(jobs.train_other, tmp_path, settings, "quick", 1, 2)
    options = parsed(start)
    assert (options.preset, options.config.seed, options.calibration) == ("quick", 2, calibration)
    assert options.config == dataclasses.replace(PRESETS["quick"], seed=2)  # not the settings of the others
    (start,) = commands(jobs.train_other, tmp_path, settings, "payload", 1, 2)
    assert parsed(start).config.env == dataclasses.replace(PRESETS["payload"].env, n_poses=64)  # alike
    (start,) = commands(jobs.train_other, tmp_path, settings, "chambers", 1, 2)
    options = parsed(start)
    assert (options.preset, options.spec, options.calibration) == ("analytic", calibration / ARM_FILE, None)
    assert options.config.env.n_poses == 64 and options.out == tmp_path / learned_run("chambers", 1, 2)
    (options.out).mkdir()
    (options.out / "config.json").touch()
    (resume,) = commands(jobs.train_other, tmp_path, settings, "chambers", 1, 2)
    assert parsed(resume).resume == options.out


def test_arms_without_a_network_learn_for_less_long_but_for_steps_of_the_experiment_s_own(tmp_path, commands):
    for training, n in (((), 524_288), (("learner.total_env_steps=512",), 512)):
        settings = dataclasses.replace(TINY, preset="analytic", training=training)
        (start,) = commands(jobs.train_other, tmp_path, settings, "chambers", 1, 2)
        assert parsed(start).config.learner.total_env_steps == n


def test_learning_starts_with_what_it_builds_on_resumes_or_starts_anew(tmp_path, commands):
    run, work = tmp_path / learned_run("narrow", 1, 2), (jobs.learn, tmp_path, TINY, "narrow", 1, 2)
    (start,) = commands(*work)
    options = parsed(start)
    assert options.file == tmp_path / jobs.demonstrations_path(1, "pipe250")
    config = options.config
    assert (options.preset, config.seed, options.out, config.env.pipe_diameter_mm) == ("pipe", 2, run, 250)
    assert options.reward == tmp_path / learned_run("pipe", 1, 2)
    (run / "checkpoints").mkdir(parents=True)
    (run / "config.json").touch()  # interrupted before it had the reward
    assert commands(*work) == [start]
    assert not run.exists()
    (run / "checkpoints" / "0").mkdir(parents=True)  # interrupted before it was a run
    assert commands(*work) == [start]
    (run / "checkpoints" / "0").mkdir(parents=True)
    (run / "config.json").touch()
    assert parsed(commands(*work)[0]).resume == run
    (agent,) = commands(jobs.learn, tmp_path, TINY, "circle", 1, 2)
    assert parsed(agent).agent == tmp_path / learned_run("quick", 1, 2)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if KINDS[kind].task])
def test_settings_of_each_kind_are_known(tmp_path, commands, kind):
    (arguments,) = commands(jobs.learn, tmp_path, SMOKE, kind, 0, 0)
    options = parsed(arguments)
    config = options.config
    assert config.learner.n_epochs == 2
    assert config.learner.stage_epochs == ((0, 1) if kind == "circle" else (0,))
    assert (options.reward is not None) == (kind in ("narrow", "narrow-learned"))
    assert (config.learner.hand_made_weight > 0) == (
        kind in ("hand-made", "narrow", "narrow-hand-made", "circle")
    )
    assert config.env.pipe_diameter_mm == {"pipe300": 300, "pipe250": 250, "circle16": None}[KINDS[kind].task]


def test_scene_is_the_twin_in_its_pipe(tmp_path, make_arm_model, monkeypatch):
    shown = SimpleNamespace(positions=np.float32(goals_of("narrow")[1]))
    monkeypatch.setattr("train.demos.demonstrations.load_demonstrations", lambda path, spec: shown)
    for kind in ("narrow", "circle"):
        (tmp_path / learned_run(kind, 0, 0)).mkdir()
        save_policy(tmp_path / learned_run(kind, 0, 0) / "policy.npz", make_policy(make_arm_model))
    found = scene.scene_of(tmp_path, TINY, pipe_trial(kind="narrow"))
    assert found.twin._pipe == CrossPipe.of_mm(250.0)
    assert len(found.goals) == len(found.names) == 37
    operations = [name for name in found.names if name.startswith(("pick", "place"))]
    assert operations == ["pick left", "place bottom", "pick right", "place left"]
    few = dataclasses.replace(TINY, n_positions=7)
    found = scene.scene_of(tmp_path, few, pipe_trial(kind="narrow"))
    assert len(found.goals) == 7 and found.names[-1] == "pick left"
    found = scene.scene_of(tmp_path, TINY, pipe_trial(kind="circle"))
    assert found.twin._pipe is None
    assert np.array_equal(found.goals, circle_poses(SPEC, TINY.n_points).astype(float))
    rods = dataclasses.replace(TINY, arm="rod")
    assert isinstance(scene.scene_of(tmp_path, rods, pipe_trial(kind="circle")).twin, RodTwin)


def test_without_s2r_the_nominal_policy_plans_and_the_springs_are_calibrated(tmp_path, make_arm_model):
    calibrated = SPEC.replace(sensor={"beta": 0.9, "delta_m": 0.004}, springs={"length_min_m": 0.1})
    for twin, spec in ((None, SPEC), (0, calibrated)):
        (tmp_path / reach_run(twin, 0)).mkdir()
        save_policy(tmp_path / reach_run(twin, 0) / "policy.npz", make_policy(make_arm_model, spec))
    chosen = scene.controller_of(tmp_path, Trial("without", 0, 0))
    assert np.array_equal(chosen.policy.sensor.beta, calibrated.spring_sensor.beta)
    assert chosen.policy.spec == SPEC
    pose, goal = circle_poses(SPEC, 2).astype(float)
    expected = PolicyRunner(make_policy(make_arm_model)).act(pose, goal).length_m
    assert np.allclose(chosen.plan(pose, goal, np.full(N, 0.2), None), expected)
    specified = scene.controller_of(tmp_path, Trial("specified", 0, 0))
    assert np.allclose(specified.plan(pose, goal, np.full(N, 0.2), None), expected)
    assert np.array_equal(specified.policy.sensor.beta, SPEC.spring_sensor.beta)
    with_s2r = scene.controller_of(tmp_path, Trial("with", 0, 0)).plan(pose, goal, 0, None)
    assert not np.allclose(with_s2r, expected)


@pytest.mark.parametrize("arm", ["twin", "rod"])
def test_policy_goes_to_a_point_on_a_twin(tmp_path, make_arm_model, monkeypatch, arm):
    # The made-up networks' arm reaches no point of the circle.
    monkeypatch.setattr("mjx_softarm.deploy.session.refusals", lambda policy, goals: {})
    settings, trial = dataclasses.replace(TINY, n_points=1, arm=arm), Trial("with", 0, 0, load_g=300)
    (tmp_path / reach_run(0, 0)).mkdir()
    spec = SPEC.replace(control={"ki_kpa_per_ms": 1000.0})  # slow enough for the rod's regulators
    save_policy(tmp_path / reach_run(0, 0) / "policy.npz", make_policy(make_arm_model, spec))
    jobs.try_out(tmp_path, settings, trial)
    outcome = load_arrays(TrialOutcome, tmp_path / trial.result)
    assert np.isfinite(outcome.error).all() and not outcome.operation.any()
    # The actor asks for the same springs for each goal, and the arm holds them with its load.
    assert not outcome.saturated.any()
    assert np.linalg.norm(outcome.error[0, :3]) > 10.0
    assert not outcome.wall_n.any()
