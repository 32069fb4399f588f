"""The engine: stages run once, in their order, elsewhere; the folder keeps its settings."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.harness import parallel
from benchmarks.harness.parallel import JobError
from benchmarks.paper import engine
from benchmarks.paper.engine import WorkStage, claim, run_stages
from tests.benchmarks.paper.made_up import TINY


def leave(folder, settings, name, done):
    """Do what a stage does: leave its result."""
    (folder / name).touch()
    done.append(name)
    return name.upper()


def test_stages_run_group_by_group_and_only_where_a_result_is_missing(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(engine, "in_parallel", lambda jobs: {name: f(*inputs) for name, f, inputs in jobs})
    groups = [
        [WorkStage(f"stage {name}", (name,), leave, (name, done)) for name in group] for group in ("ab", "c")
    ]
    assert run_stages(tmp_path, TINY, groups) == {"stage a": "A", "stage b": "B", "stage c": "C"}
    assert done == ["a", "b", "c"]
    (tmp_path / "b").unlink()
    assert run_stages(tmp_path, TINY, groups) == {"stage b": "B"}
    two = [[WorkStage("both", ("a", "d"), leave, ("d", done))]]
    assert run_stages(tmp_path, TINY, two) == {"both": "D"}  # one of its results is missing


def test_folder_of_other_settings_is_refused(tmp_path):
    claim(tmp_path, TINY)
    claim(tmp_path, dataclasses.replace(TINY, twins=(0, 1, 2), seeds=(5,), loads_g=(35,)))
    with pytest.raises(JobError, match=r"settings.json: got n_points 3, expected n_points 40;"):
        claim(tmp_path, dataclasses.replace(TINY, n_points=40))


def test_jobs_run_elsewhere_and_a_failure_is_named():
    assert parallel.in_parallel([("a", pow, (2, 3)), ("b", divmod, (7, 2))]) == {"a": 8, "b": (3, 1)}
    with pytest.raises(JobError, match="bad: ValueError: invalid literal"):
        parallel.in_parallel([("bad", int, ("x",))])


SLEEPY = """
import os, time
from benchmarks.harness.parallel import in_parallel
from tests.benchmarks.paper.test_engine import sleep_long
if __name__ == "__main__":
    in_parallel([("long", sleep_long, ())])
"""


def sleep_long():
    """A job that tells its process, and does not end by itself."""
    print(os.getpid(), flush=True)
    time.sleep(600.0)


@pytest.mark.skipif(not Path("/proc").exists(), reason="there is no /proc to see processes in")
def test_workers_end_with_a_benchmark_that_is_killed(tmp_path):
    (tmp_path / "sleepy.py").write_text(SLEEPY)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])}
    command = [sys.executable, str(tmp_path / "sleepy.py")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as benchmark:
        assert benchmark.stdout is not None
        worker = int(benchmark.stdout.readline())
        os.kill(worker, 0)  # it is there
        benchmark.send_signal(signal.SIGKILL)
        until = time.monotonic() + 60.0
        while Path(f"/proc/{worker}").exists() and time.monotonic() < until:
            time.sleep(0.05)
        assert not Path(f"/proc/{worker}").exists()
