"""The folder of a run: refused in words, its metrics forgotten with the epochs."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from calib.arm import CalibratedArm
from mjx_softarm._support.errors import InputError
from mjx_softarm.env import EnvConfig
from mjx_softarm.spec import ArmSpec
from train.config import TrainConfig
from train.epoch.replay_epoch import ReplayState
from train.runs.folder import Run

CONFIG, ARM = TrainConfig(), CalibratedArm(ArmSpec.default())


def test_a_folder_that_is_no_run_is_named(tmp_path):
    with pytest.raises(InputError, match="config.json: got 'No such file.*expected the folder of a run"):
        Run.open(tmp_path)
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(InputError, match="config.json: got a damaged config or another version's"):
        Run.open(tmp_path)
    with pytest.raises(InputError, match="got a folder with a run, .*--resume"):
        Run.create(tmp_path, CONFIG, ARM)


def test_a_run_has_the_links_that_it_was_trained_with(tmp_path):
    config = dataclasses.replace(CONFIG, env=EnvConfig(links_per_section=2))
    Run.create(tmp_path, config, ARM)
    assert Run.open(tmp_path).spec.structure.links_per_section == 2
    with pytest.raises(InputError, match="links_per_section: got 2, expected 4, as the sim-to-real network"):
        Run(tmp_path, config, ARM._replace(s2r=object()))


def test_metrics_later_than_the_checkpoint_are_forgotten(tmp_path):
    run = Run.create(tmp_path, CONFIG, ARM)
    for epoch in range(1, 5):
        run.log({"epoch": epoch})
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"epoch": 5, "cut')
    run.rewind(2)
    assert run.metrics() == [{"epoch": 1}, {"epoch": 2}]


@pytest.fixture
def saved(tmp_path):
    """A run with checkpoints of two epochs, and the shapes of its state."""
    zero = jnp.zeros((), jnp.int32)
    state = ReplayState(None, {"weight": jnp.arange(64.0)}, None, (), zero, zero)
    run = Run.create(tmp_path / "run", CONFIG, ARM)
    for epoch in (10, 20):
        run.checkpoints.save(epoch, state, {"policy": {"weight": jnp.arange(64.0)}})
    return run, jax.eval_shape(lambda: state)


def cut(file):
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


@pytest.mark.parametrize("item", ["parts", "state"])
@pytest.mark.parametrize("files", ["_METADATA", "manifest.ocdbt", "**/d/*"])
@pytest.mark.parametrize("spoil", [cut, lambda file: file.unlink()])
def test_a_damaged_checkpoint_is_called_so(saved, item, files, spoil):
    run, like = saved
    folder = run.path / "checkpoints/20" / item
    for file in folder.glob(files):
        spoil(file)
    with pytest.raises(InputError, match=rf"{folder}: got a damaged checkpoint .*back to epoch 10"):
        reopened = Run.open(run.path)
        reopened.checkpoints.parts() if item == "parts" else reopened.checkpoints.restore(like)


def test_a_run_that_began_with_another_s_policy_does_not_begin_anew_without_it(tmp_path):
    run = Run.create(tmp_path, CONFIG, ARM, begins_with={"agent": tmp_path / "other"})
    with pytest.raises(InputError, match="got no checkpoint of a run with 0 epochs"):
        run.check_begins_anew()
