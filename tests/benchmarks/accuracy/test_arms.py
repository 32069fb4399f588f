"""Commands that the benchmark of other arms runs: which exit statuses end it."""

import contextlib
import subprocess
import sys

import pytest

from benchmarks.accuracy.arms import run_command
from mjx_softarm._support.errors import InputError


@pytest.mark.parametrize("status", [0, 1, 2, 3, 130, -9])
def test_a_command_with_results_goes_on_with_its_status_and_one_that_failed_ends_the_benchmark(
    monkeypatch, status
):
    asked = []
    done = subprocess.CompletedProcess([], status)
    monkeypatch.setattr(subprocess, "run", lambda command, check: asked.append(command) or done)
    told = f"python -m calib run 3: got exit status {status}, expected 0 or 1"
    with contextlib.nullcontext() if status in (0, 1) else pytest.raises(InputError, match=told):
        assert run_command("calib", "run", 3) == status
    assert asked == [[sys.executable, "-m", "calib", "run", "3"]]
