"""The stages in confined spaces: which there are, what each is told to do, and what it leaves."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.harness.parallel import JobError
from benchmarks.paper import confined_stages
from benchmarks.paper.confined_measure import save_operated
from benchmarks.paper.confined_stages import (
    KINDS,
    Trial,
    circles,
    demonstrations_file,
    learned_folder,
    load_results,
    trainings,
    trial_file,
    trials,
)
from benchmarks.paper.measure import save_followed
from benchmarks.paper.stages import SMOKE, Settings, policy_folder, result_file
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.mechanics.workspace import circle_poses
from mjx_softarm.policy.file import policy_from_actor, save_policy
from tests.benchmarks.paper.confined_runs import SPEC, TINY, N, followed, made_up, positions
from train import __main__ as train_main
from train.config import IMITATION_PRESETS, to_dict


def test_three_twins_and_three_seeds():
    found = trials(Settings())
    assert len(found) == len(set(found)) == 9 * 5
    learned_ones = trainings(Settings())
    assert len(learned_ones) == len(set(learned_ones)) == 4 * 9 + 3
    assert sum(kind == "no-penalty" for kind, _, _ in learned_ones) == 3


def test_stage_ends_come_from_the_runs_config(tmp_path):
    settings = Settings(twins=(0,), seeds=(0,))
    for item in trainings(settings):
        run = learned_folder(tmp_path, *item)
        run.mkdir()
        config = to_dict(IMITATION_PRESETS[KINDS[item[0]].preset])
        (run / "config.json").write_text(json.dumps({"train": config}))
        (run / "metrics.jsonl").write_text('{"epoch": 1}\n{"epoch": 2}\n')
    (tmp_path / "results").mkdir()
    for trial in trials(settings):
        save_operated(trial_file(tmp_path, trial), made_up(trial.kind))
    save_followed(result_file(tmp_path, circles(settings)[0]), followed(1.0))
    found = load_results(tmp_path, settings)
    assert found.learned["circle", 0, 0].stage_ends == (7,)  # 20 epochs, a third of them first
    assert found.learned["pipe", 0, 0].stage_ends == ()
    assert [row["epoch"] for row in found.learned["pipe", 0, 0].rows] == [1, 2]


def test_training_starts_with_what_it_builds_on_resumes_or_starts_anew(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(confined_stages, "command", lambda log, *arguments: calls.append(arguments))
    settings = dataclasses.replace(TINY, imitation=("n_arms=16",))
    demonstrations = str(demonstrations_file(tmp_path, 1, "pipe250"))
    run = learned_folder(tmp_path, "narrow", 1, 2)

    def commands(kind="narrow"):
        calls.clear()
        confined_stages.learn(tmp_path, settings, kind, 1, 2)
        return calls

    start = ["imitate", demonstrations, "--preset", "frozen", "--seed", "2", "--out", str(run)]
    start += ["--calibration", str(tmp_path / "twin1" / "calibration"), "--pipe", "250"]
    start += ["--reward", str(learned_folder(tmp_path, "pipe", 1, 2)), "--set", "n_arms=16"]
    assert commands() == [tuple(start)]
    (run / "checkpoints").mkdir(parents=True)
    (run / "config.json").touch()  # interrupted before it had the reward
    assert commands()[0] == tuple(start)
    assert not run.exists()
    (run / "checkpoints" / "0").mkdir(parents=True)  # interrupted before it was a run
    assert commands() == [tuple(start)]
    (run / "checkpoints" / "0").mkdir(parents=True)
    (run / "config.json").touch()
    assert commands() == [("imitate", "--resume", str(run))]
    (run / "evaluation.json").touch()
    assert commands() == []
    agent = commands("circle")[0]
    assert agent[agent.index("--agent") + 1] == str(policy_folder(tmp_path, 1, 2))
    assert parsed(agent).agent == policy_folder(tmp_path, 1, 2)
    assert "--pipe" not in agent
    assert "gail.gradient_penalty=0" in commands("no-penalty")[0]


def test_policies_that_are_tried_out_are_exported_in_one_go(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(confined_stages, "command", lambda log, *arguments: calls.append(arguments))
    settings = Settings(twins=(0, 1), seeds=(2,))
    done = learned_folder(tmp_path, "circle", 0, 2) / "policy.npz"
    done.parent.mkdir()
    done.touch()
    confined_stages.export(tmp_path, settings, 0)
    wanted = [str(learned_folder(tmp_path, kind, 0, 2)) for kind in ("hand-made", "narrow", "pipe")]
    assert calls == [("export", *wanted)]
    assert parsed(calls[0]).runs == [Path(path) for path in wanted]
    for path in wanted:
        (Path(path) / "policy.npz").parent.mkdir()
        (Path(path) / "policy.npz").touch()
    confined_stages.export(tmp_path, settings, 0)
    assert len(calls) == 1


def parsed(arguments):
    """What the command line makes of them; it ends the test where it does not know one."""
    return train_main._parser().parse_args(arguments)


@pytest.mark.parametrize("kind", KINDS)
def test_settings_of_each_kind_are_known(tmp_path, monkeypatch, kind):
    calls = []
    monkeypatch.setattr(confined_stages, "command", lambda log, *arguments: calls.append(arguments))
    confined_stages.learn(tmp_path, SMOKE, kind, 0, 0)
    options = parsed(calls[0])
    config = train_main._config(IMITATION_PRESETS[options.preset], options)
    assert config.n_epochs == 2
    assert config.stage_epochs == ((0, 1) if kind == "circle" else (0,))
    assert (config.gail.gradient_penalty == 0) == (kind == "no-penalty")
    assert (options.reward is not None) == (kind == "narrow")
    assert options.pipe == {"narrow": 250, "circle": None}.get(kind, 300)


def test_recording_that_ends_early_is_no_demonstration(tmp_path, monkeypatch):
    file = demonstrations_file(tmp_path, 3, "pipe300")
    file.parent.mkdir()

    def ends_early(log, *arguments):
        assert arguments[:4] == ("demos", "record", "--arm", "twin:3:pipe300")
        assert parsed(arguments).task == "pipe300"
        (tmp_path / "twin3" / arguments[-1]).write_text("half of it")
        raise JobError("ended early")

    monkeypatch.setattr(confined_stages, "command", ends_early)
    with pytest.raises(JobError):
        confined_stages.demonstrate(tmp_path, 3, "pipe300")
    assert not file.exists()


def test_scene_is_the_twin_in_its_pipe(tmp_path, make_arm_model, monkeypatch):
    dense = {"head": {"kernel": np.zeros((18, 2 * N)), "bias": np.zeros(2 * N)}}
    policy = policy_from_actor({"params": dense}, SPEC, RewardConfig(), make_arm_model(N), {})
    shown = SimpleNamespace(positions=np.float32(positions("narrow")[1]))
    monkeypatch.setattr("train.demos.demonstrations.load_demonstrations", lambda path, spec: shown)
    for kind in ("narrow", "circle"):
        folder = learned_folder(tmp_path, kind, 0, 0)
        folder.mkdir()
        save_policy(folder / "policy.npz", policy)
    scene = confined_stages.scene_of(tmp_path, TINY, Trial("narrow", 0, 0))
    assert scene.twin.describe()["pipe"]["diameter_m"] == 0.25
    assert len(scene.goals) == len(scene.names) == 37
    assert [name for name in scene.names if name.startswith(("pick", "place"))] == [
        "pick left",
        "place bottom",
        "pick right",
        "place left",
    ]
    few = dataclasses.replace(TINY, n_positions=7)
    scene = confined_stages.scene_of(tmp_path, few, Trial("narrow", 0, 0))
    assert len(scene.goals) == 7 and scene.names[-1] == "pick left"
    scene = confined_stages.scene_of(tmp_path, TINY, Trial("circle", 0, 0))
    assert "pipe" not in scene.twin.describe()
    assert np.array_equal(scene.goals, circle_poses(TINY.n_points).astype(float))
