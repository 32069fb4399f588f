"""Virtual environments of peers, without making one: what marks them complete."""

import subprocess
from importlib import metadata
from unittest.mock import Mock

import pytest

from benchmarks.harness import peers
from benchmarks.harness.peers import MARKER, PINS, SHARED, PeerError, peer_packages, peer_python


@pytest.fixture
def made(monkeypatch):
    """A list of the packages of each environment that was made, in place of making it."""
    made = []

    def make(home, python, packages):
        home.mkdir(exist_ok=True)
        made.append(packages)

    monkeypatch.setattr(peers, "_make", make)
    return made


@pytest.mark.parametrize("name", PINS)
def test_every_requirement_is_pinned_and_the_simulator_s_are_those_that_run_here(name):
    requirements = dict(pin.replace("[cuda12]", "").split("==") for pin in peer_packages(name))
    pins = dict(pin.split("==") for pin in PINS[name])
    assert requirements == pins | {shared: metadata.version(shared) for shared in SHARED}


def test_an_environment_is_made_once_and_anew_for_a_changed_pin_or_python(made, monkeypatch, tmp_path):
    first = peer_python("sbx", tmp_path)
    assert peer_python("sbx", tmp_path) == first == tmp_path / ".venv-sbx/bin/python"
    monkeypatch.setitem(PINS, "sbx", ("sbx-rl==0.0.1",))
    peer_python("sbx", tmp_path)
    marker = tmp_path / ".venv-sbx" / MARKER
    marker.write_text("python 3.1\n", "utf-8")
    peer_python("sbx", tmp_path)
    assert [packages[0] for packages in made[1:]] == ["sbx-rl==0.0.1"] * 2 and len(made) == 3


def test_why_an_environment_cannot_be_made_is_told_in_one_line(monkeypatch, tmp_path):
    failed = subprocess.CalledProcessError(1, ["pip"], stderr="a\nERROR: No matching distribution\n")
    monkeypatch.setattr(peers, "_make", Mock(side_effect=failed))
    with pytest.raises(PeerError, match=r"^sbx: got ERROR: No matching distribution, expected .*\.venv-sbx$"):
        peer_python("sbx", tmp_path)
    assert not (tmp_path / ".venv-sbx" / MARKER).exists()
