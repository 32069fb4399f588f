"""Commands that the benchmark of other arms runs: which exit statuses end it."""

import subprocess
import sys

import pytest

from benchmarks.accuracy.arms import run_command
from mjx_softarm._support.errors import InputError


@pytest.mark.parametrize("status", [0, 1])
def test_a_command_that_did_its_work_goes_on_with_its_status(monkeypatch, status):
    asked = []

    def run(command, check):
        asked.append(command)
        return subprocess.CompletedProcess(command, status)

    monkeypatch.setattr(subprocess, "run", run)
    assert run_command("calib", "run", 3) == status
    assert asked == [[sys.executable, "-m", "calib", "run", "3"]]


@pytest.mark.parametrize("status", [2, 3, 130, -9])
def test_a_command_that_failed_ends_the_benchmark(monkeypatch, status):
    monkeypatch.setattr(
        subprocess, "run", lambda command, check: subprocess.CompletedProcess(command, status)
    )
    with pytest.raises(InputError, match=f"python -m calib run 3: got exit status {status}, expected 0 or 1"):
        run_command("calib", "run", 3)
