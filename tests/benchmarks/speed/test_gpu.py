"""Targets for a GPU, judged on made-up figures and with a made-up training."""

import json
import sys

import pytest

from benchmarks.speed import gpu
from train.config import override
from train.presets import PRESETS


def rates(**engines):
    mode = {"mode": "quasistatic"}
    points = [(engine, n, rate) for engine, measured in engines.items() for n, rate in measured.items()]
    rows = [{"engine": engine, **mode, "arms": n, "env_steps_per_s": rate} for engine, n, rate in points]
    return [*rows, {"engine": "mjx", "mode": "dynamic", "arms": 1, "env_steps_per_s": 10**9}]


def test_targets_of_a_gpu_are_judged_at_the_best_number_of_arms_and_skipped_without_one():
    targets = gpu.rate_targets(rates(chain={1: 5, 8192: 300_000, 32_768: 7}, mjx={8192: 29_999}), on_gpu=True)
    assert [row["verdict"] for row in targets] == ["met", "NOT MET"]
    assert targets[0]["measured"] == "300,000 with 8,192 arms"
    targets = gpu.rate_targets(rates(chain={1: 10**6}, mjx={1: 10**6}), on_gpu=False)
    targets.append(gpu.training_target(on_gpu=False))
    assert {row["verdict"] for row in targets} == {"skipped"}
    assert {row["measured"] for row in targets} == {gpu.NO_DEVICE}


def test_the_training_for_a_gpu_has_settings_that_there_are():
    config = override(PRESETS["quick"], list(gpu.TRAINING))
    assert config.n_arms == 2048 and config.n_updates_per_vector_step == 64


TRAINING = """
import json, sys, time
sys.stderr.write("x" * 10**6 + "\\n")  # more than a pipe holds
with open(sys.argv[1], "w", buffering=1) as file:
    for median in (9.0, None, 4.0, 2.5):
        file.write(json.dumps({"epoch": 1} if median is None else {"evaluation/median_mm": median}) + "\\n")
    file.write('{"evaluation/median_mm": 1')
    file.flush()
    time.sleep(float(sys.argv[2]))
"""


@pytest.mark.parametrize("median_mm, reached", [(3.0, True), (2.0, False)])
def test_time_to_a_median_is_read_from_the_metrics_of_a_run(tmp_path, median_mm, reached):
    metrics = tmp_path / "metrics.jsonl"
    sleep = "60" if reached else "0"  # stopped as soon as it is there
    command = [sys.executable, "-c", TRAINING, str(metrics), sleep]
    spent, best = gpu.seconds_to(median_mm, command, metrics, 30.0, {})
    assert (spent is not None) == reached and best == 2.5
    assert json.loads(metrics.read_text().splitlines()[0]) == {"evaluation/median_mm": 9.0}
