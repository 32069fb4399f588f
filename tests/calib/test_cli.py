"""`python -m calib` as a user runs it: the demo calibrated and taken by training; bad input refused."""

import dataclasses
import json

import numpy as np
import pytest

import calib.demo
from calib.__main__ import main
from calib.arm import CalibratedArm
from calib.demo import planted_arm, write_demo
from calib.fit import s2r
from calib.fit.payload import held_at
from calib.read.logs import read_log
from mjx_softarm import ArmSpec
from mjx_softarm.logs.schema import write_log
from mjx_softarm.sensing.s2r import load_s2r


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Logs of the planted arm of seed 0, fewer than the command writes."""
    folder = tmp_path_factory.mktemp("demo") / "logs"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calib.demo, "N_POSES", 300)
        patch.setattr(calib.demo, "N_STEPS", 3)
        files = write_demo(folder, ArmSpec.default(), seed=0)
    return [str(file) for file in files]


@pytest.fixture(scope="module")
def calibrated(demo, tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrated") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calib.fit.s2r.N_POINTS", 6_000)
        schedule = s2r.OF_PROCESS.schedule._replace(n_updates=2_000)
        patch.setattr(s2r, "OF_PROCESS", dataclasses.replace(s2r.OF_PROCESS, schedule=schedule))
        status = main(["run", *demo, "--out", str(folder)])
    return status, folder


def test_run_writes_the_whole_folder_and_nothing_beside_it(calibrated):
    status, folder = calibrated
    names = ["arm.toml", "pressures.npz", "report.html", "report.json", "s2r.npz"]
    assert sorted(p.name for p in folder.iterdir()) == names
    assert [p.name for p in folder.parent.iterdir()] == ["out"]
    report = json.loads((folder / "report.json").read_text())
    assert status == (0 if report["trustworthy"] else 1)
    planted = planted_arm(ArmSpec.default(), seed=0)
    np.testing.assert_allclose(
        ArmSpec.from_toml(folder / "arm.toml").sensor.beta, planted.sensor.beta, rtol=0.005
    )


def test_each_step_brings_the_simulated_tip_closer_to_held_out_poses(calibrated):
    parts = json.loads((calibrated[1] / "report.json").read_text())["parts"]
    mean = "translation_mean_mm"
    chambers, network = parts["Chambers"]["figures"], parts["Sim-to-real network"]["figures"]
    assert chambers["held_out"][mean] < 0.5 * chambers["held_out_before"][mean]
    bending, found = "bending_stiffness_nm_per_rad", ArmSpec.from_toml(calibrated[1] / "arm.toml")
    assert chambers["values"][bending] == found.backbone.bending_stiffness_nm_per_rad
    assert network["n_unsettled"] == 0
    corrected, simulated = network["test"], network["test_uncorrected"]
    assert corrected[mean] < 0.8 * simulated[mean]
    assert corrected["rotation_mean_deg"] < 0.8 * simulated["rotation_mean_deg"]


def test_a_calibration_goes_on_with_a_later_log(demo, calibrated, tmp_path, capsys):
    """Later, two springs read 1.5 mm less; the rest of the folder stays."""
    before, later, out = calibrated[1], tmp_path / "later.npz", tmp_path / "new"
    spec = ArmSpec.from_toml(before / "arm.toml")
    log = read_log(demo[1], spec)[0].take(np.arange(60))
    shift_m = 1.5e-3 * np.isin(np.arange(9), (1, 5))
    length_m = spec.spring_sensor.lengths(log.readings).length_m
    later_log = dataclasses.replace(log, readings=spec.spring_sensor.readings(length_m - shift_m))
    write_log(later, later_log)
    main(["run", str(later), "--since", str(before), "--out", str(out)])
    said = capsys.readouterr().out
    assert "note: Changes: zeros of the springs " in said and "next: python -m train export RUN" in said
    found_m = ArmSpec.from_toml(out / "arm.toml").spring_sensor.delta_m - spec.spring_sensor.delta_m
    np.testing.assert_allclose(found_m, shift_m, atol=7e-4)
    assert (out / "s2r.npz").read_bytes() == (before / "s2r.npz").read_bytes()
    assert sorted(p.name for p in out.iterdir()) == sorted(p.name for p in before.iterdir())


WRONG, FEW = "check the weight and its unit", "expected 8: measure more goals with a known"


@pytest.mark.parametrize(("n", "kg", "why"), [(20, 0.5, ""), (20, 5.0, WRONG), (20, 0.2, FEW), (5, 0.5, FEW)])
def test_a_known_weight_tells_how_payloads_are_felt(demo, calibrated, tmp_path, capsys, n, kg, why):
    """The arm feels 0.9 of a payload. A wrong or light weight, or few poses, change nothing."""
    before, later, out = calibrated[1], tmp_path / "heavy.npz", tmp_path / "new"
    arm = CalibratedArm.read(before)
    log = read_log(demo[1], arm.spec)[0].take(np.arange(n))
    spring_m = arm.spec.spring_sensor.lengths(log.readings).length_m
    effect_kpa = 0.5 * 0.9 * held_at(arm, spring_m)[0].effect_kpa_per_kg
    heavy = {"pressure_kpa": log.pressure_kpa + effect_kpa, "payload_kg": np.full(n, kg)}
    write_log(later, dataclasses.replace(log, **heavy))
    status, said = main(["run", str(later), "--since", str(before), "--out", str(out)]), capsys.readouterr()
    found = CalibratedArm.read(out)
    assert found.spec == arm.spec
    if not why:
        assert found.held.factor == pytest.approx(0.9, abs=0.03) and found.held.factor_sd < 0.04
        assert "note: Payloads: payloads were estimated 1" in said.out and "% too light" in said.out
    else:
        assert found.held.factor == 1.0 and status == 1 and why in said.out


def test_training_takes_the_folder(calibrated, tmp_path, monkeypatch):
    """The run has the calibrated arm and its network, and so has what is opened from it."""
    from train.__main__ import main as train_main
    from train.runs.folder import Run

    tasks, folder = [], calibrated[1]
    monkeypatch.setattr("train.runs.run.train", lambda run, task, console: tasks.append(task))
    monkeypatch.setattr("train.runs.command._show", lambda *_: None)
    small = ["--env.n-poses", "64", "--out", str(tmp_path / "run")]
    assert train_main(["reach", "--calibration", str(folder), *small]) == 0
    env, opened = tasks[0].job.env, Run.open(tmp_path / "run")
    assert env.spec == opened.spec == ArmSpec.from_toml(folder / "arm.toml")
    network = load_s2r(folder / "s2r.npz", 9)
    for found in (env.s2r, opened.arm.s2r):
        np.testing.assert_array_equal(found.anchors, network.anchors)
    plain = type(env)(env.spec, env.config)
    assert np.abs(env.pool.pose - plain.pool.pose)[:, :3].max() > 0.5
    np.testing.assert_array_equal(env.pool.spring_m, plain.pool.spring_m)


def test_logs_without_poses_or_ruler_say_what_is_missing(demo, tmp_path, capsys):
    """Springs alone: the rest of the arm stays as specified, nothing is invented."""
    assert main(["run", demo[0], "--out", str(tmp_path / "out")]) == 1
    out = capsys.readouterr().out
    assert out.startswith("arm: paper, by default; --spec names another arm\n")
    assert "warning: Chambers: stiffness, area and length are not this arm's" in out
    assert "warning: Sim-to-real network: policies will be trained on simulated poses" in out
    assert not (tmp_path / "out" / "s2r.npz").exists()
    found = ArmSpec.from_toml(tmp_path / "out" / "arm.toml")
    assert found.chambers == ArmSpec.default().chambers


def test_check_takes_the_arm_s_number_of_chambers(demo, tmp_path, capsys):
    six = ArmSpec.default().replace(structure={"n_sections": 2})
    six.to_toml(tmp_path / "six.toml")
    log, _ = read_log(demo[0])
    six_columns = dataclasses.replace(log, readings=log.readings[:, :6], spring_m=log.spring_m[:, :6])
    write_log(tmp_path / "six.csv", six_columns)
    assert main(["check", str(tmp_path / "six.csv")]) == 2
    assert main(["check", str(tmp_path / "six.csv"), "--spec", str(tmp_path / "six.toml")]) == 0


def test_what_cannot_be_used_is_refused_in_a_line_and_nothing_is_written(demo, calibrated, tmp_path, capsys):
    short = read_log(demo[1])[0].take(np.arange(20))
    other, bad = tmp_path / "other.csv", tmp_path / "bad.csv"
    bad.write_bytes(b"time [s];pressure0 [kPa]\n0;1\n1;2\n")
    write_log(other, dataclasses.replace(short, tip_m=3.0 * short.tip_m))
    before, out = (calibrated[1] / "arm.toml").read_bytes(), tmp_path / "out"
    for arguments, words in (
        ([tmp_path], str(tmp_path)),
        ([bad], str(bad)),
        ([tmp_path / "absent.csv"], "absent.csv"),
        ([demo[1], other], "expected ranges that meet in logs of one arm"),
        ([demo[1], "--spec", tmp_path / "absent.toml"], "absent.toml"),
        ([], "LOG: got nothing"),
        ([demo[0], "--seed", -1], "--seed: got -1"),
        ([demo[0], "--since", "before", "--spec", "paper"], "--spec: got paper and --since before"),
        ([demo[0], "--since", "before", "--s2r", "printed"], "--s2r: got --since before"),
        ([demo[0], "--out", calibrated[1]], "which is there already, expected a new folder"),
    ):
        assert main(["run", "--out", str(out), *map(str, arguments)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and words in error and len(error.splitlines()) == 1
    assert not out.exists() and (calibrated[1] / "arm.toml").read_bytes() == before
