"""Virtual environments of peers, without making one: what marks them complete."""

import re
import subprocess
from importlib import metadata
from unittest.mock import Mock

import pytest
from packaging.requirements import Requirement

from benchmarks.harness import peers
from benchmarks.harness.peers import MARKER, PINS, SHARED, peer_python
from mjx_softarm._support.errors import InputError


@pytest.fixture
def install(monkeypatch):
    """The call of pip, in place of making an environment."""
    monkeypatch.setattr(peers.venv, "create", lambda home, **_: home.mkdir(exist_ok=True))
    monkeypatch.setattr(peers.subprocess, "run", Mock())
    return peers.subprocess.run


def test_the_simulator_s_packages_are_shared():
    """A peer trains on this project's environment."""
    required = [Requirement(text) for text in metadata.requires("mjx-softarm") or ()]
    needed = {one.name for one in required if not one.marker or one.marker.evaluate({"extra": "sim"})}
    assert "brax" in needed and {re.sub("[-_.]+", "-", name) for name in needed} <= {
        re.sub("[-_.]+", "-", name) for name in SHARED
    }


def test_an_environment_is_made_once_and_anew_for_a_changed_pin_or_python(install, monkeypatch, tmp_path):
    assert peer_python("sbx", tmp_path) == peer_python("sbx", tmp_path) == tmp_path / ".venv-sbx/bin/python"
    assert install.call_count == 1 and "sbx-rl==0.28.0" in install.call_args[0][0]
    monkeypatch.setitem(PINS, "sbx", ("sbx-rl==0.0.1",))
    peer_python("sbx", tmp_path)
    (tmp_path / ".venv-sbx" / MARKER).write_text("python 3.1\n", "utf-8")
    peer_python("sbx", tmp_path)
    assert install.call_count == 3


def test_an_environment_that_cannot_be_made_is_an_error_of_one_line(install, tmp_path):
    install.side_effect = subprocess.CalledProcessError(1, ["pip"], stderr="a\nERROR: No distribution\n")
    with pytest.raises(InputError, match=r"^sbx: got ERROR: No distribution, expected .*\.venv-sbx$"):
        peer_python("sbx", tmp_path)
    assert not (tmp_path / ".venv-sbx" / MARKER).exists()
