"""Stages run once, in their order, elsewhere; a killed benchmark leaves no process and no half result."""

import os
import signal
import subprocess
import sys
import time
from collections import namedtuple
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from benchmarks.harness import stages
from benchmarks.harness.stages import WorkStage, claim, command, load_arrays, run_stages, save_arrays
from mjx_softarm._support.errors import InputError


@dataclass(frozen=True)
class Size:
    n_points: int = 3
    twins: tuple[int, ...] = (0,)


def leave(folder, settings, *names):
    """Leave results, and a line for each call."""
    for name in names:
        (folder / name).touch()
    with (folder / "calls.txt").open("a") as file:
        file.write(f"{' '.join(names)}\n")


def fail(folder, settings):
    raise ValueError("not today")


def sleep_long(folder, settings):
    """Print the number of this process, and do not end by itself."""
    print(os.getpid(), flush=True)
    time.sleep(600.0)


def test_stages_run_elsewhere_group_by_group_and_only_where_a_result_is_missing(tmp_path):
    groups = [
        [WorkStage("first", ("a",), leave, ("a",))],
        [WorkStage("second", ("b", "c"), leave, ("b", "c"))],
    ]
    run_stages(tmp_path, Size(), groups)
    (tmp_path / "c").unlink()  # one of two results
    run_stages(tmp_path, Size(), groups)
    assert (tmp_path / "calls.txt").read_text().splitlines() == ["a", "b c", "b c"]
    with pytest.raises(InputError, match="bad: ValueError: not today"):
        run_stages(tmp_path, Size(), [[WorkStage("bad", ("d",), fail)]])
    with pytest.raises(InputError, match="empty: InputError: got no e in .*, expected its results"):
        run_stages(tmp_path, Size(), [[WorkStage("empty", ("e",), leave, ("f",))]])


def test_a_folder_of_other_settings_is_refused(tmp_path):
    claim(tmp_path, Size(), more=("twins",))
    claim(tmp_path, Size(twins=(0, 1)), more=("twins",))
    with pytest.raises(InputError, match=r"settings.json: got n_points 3, expected n_points 40;"):
        claim(tmp_path, Size(40), more=("twins",))


@pytest.mark.parametrize(("status", "writes"), [(0, True), (1, True), (1, False), (2, True), (-9, True)])
def test_a_command_with_results_goes_on_and_another_is_named(tmp_path, monkeypatch, status, writes):
    """Status 1 says that a bound is missed, or that Python ended with a traceback."""
    log, made = tmp_path / "calib.log", tmp_path / "report.json"

    def run(words, stdout, **_):
        assert words == [sys.executable, "-m", "calib", "run", "3"]
        stdout.write("its last words")
        if writes:
            made.touch()
        return subprocess.CompletedProcess([], status)

    monkeypatch.setattr(stages.subprocess, "run", run)
    if status in (0, 1) and writes:
        command(log, "calib", "run", 3, makes=made)
    else:
        told = rf"(?s)python -m calib run 3: got exit status {status}, expected .*ends with\nits last words"
        with pytest.raises(InputError, match=told):
            command(log, "calib", "run", 3, makes=made)


def test_arrays_come_back_and_those_of_an_older_version_are_refused(tmp_path):
    kind = namedtuple("kind", "a b")
    save_arrays(tmp_path / "x.npz", kind(np.arange(3), np.array([np.nan])))
    a, b = load_arrays(kind, tmp_path / "x.npz")
    assert a.tolist() == [0, 1, 2] and np.isnan(b).all()
    with pytest.raises(InputError, match="x.npz: got no c, expected the arrays"):
        load_arrays(namedtuple("newer", "a c"), tmp_path / "x.npz")


SLEEPY = """
from pathlib import Path
from benchmarks.harness.stages import WorkStage, run_stages
from tests.benchmarks.harness.test_stages import Size, sleep_long
if __name__ == "__main__":
    run_stages(Path("."), Size(), [[WorkStage("long", ("never",), sleep_long)]])
"""


@pytest.mark.skipif(not Path("/proc").exists(), reason="there is no /proc to see processes in")
def test_workers_end_with_a_benchmark_that_is_killed(tmp_path):
    (tmp_path / "sleepy.py").write_text(SLEEPY)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])}
    words = [sys.executable, str(tmp_path / "sleepy.py")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment) as benchmark:
        assert benchmark.stdout is not None
        worker = int(benchmark.stdout.readline())
        os.kill(worker, 0)  # it is there
        benchmark.send_signal(signal.SIGKILL)
        until = time.monotonic() + 60.0
        while Path(f"/proc/{worker}").exists() and time.monotonic() < until:
            time.sleep(0.05)
        assert not Path(f"/proc/{worker}").exists()
