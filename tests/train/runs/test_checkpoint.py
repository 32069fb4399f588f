"""The folder of a run: refused in words, and its metrics forgotten with the epochs."""

import pytest

from mjx_softarm.spec import ArmSpec
from train.config import TrainConfig
from train.runs.checkpoint import Run, RunError

CONFIG = TrainConfig()


def test_a_folder_that_is_no_run_is_named(tmp_path):
    with pytest.raises(RunError, match="config.json: got 'No such file.*expected the folder of a run"):
        Run.open(tmp_path)
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(RunError, match="config.json: got a damaged config or another version's"):
        Run.open(tmp_path)
    with pytest.raises(RunError, match="got a folder with a run, .*--resume"):
        Run.create(tmp_path, CONFIG, ArmSpec.default())


def test_metrics_later_than_the_checkpoint_are_forgotten(tmp_path):
    run = Run.create(tmp_path, CONFIG, ArmSpec.default())
    for epoch in range(1, 5):
        run.log({"epoch": epoch})
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"epoch": 5, "cut')
    run.rewind(2)
    assert run.metrics() == [{"epoch": 1}, {"epoch": 2}]
