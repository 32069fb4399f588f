"""Virtual environments of peers, without making one: what marks them complete."""

import subprocess
import sys
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


@pytest.mark.parametrize(
    "name, package", [("sbx", "sbx-rl"), ("sb3-contrib", "sb3-contrib"), ("soromox", "soromox")]
)
def test_every_requirement_is_pinned_and_the_simulator_s_are_those_that_run_here(name, package):
    requirements = dict(requirement.split("==") for requirement in peer_packages(name))
    assert all(requirements.values()) and package in requirements
    found = {shared: requirements.get(shared, requirements.get(f"{shared}[cuda12]")) for shared in SHARED}
    own = dict(pin.split("==") for pin in PINS[name])
    assert own.keys().isdisjoint(SHARED) and requirements == requirements | own
    assert all(found[shared] == metadata.version(shared) for shared in SHARED)


def test_an_environment_is_made_once_and_each_peer_has_its_own(made, tmp_path):
    first = peer_python("sbx", tmp_path)
    assert first == tmp_path / ".venv-sbx" / "bin" / "python"
    assert peer_python("sbx", tmp_path) == first and len(made) == 1
    assert peer_python("sb3-contrib", tmp_path).parents[1] == tmp_path / ".venv-sb3-contrib"
    assert made == [peer_packages("sbx"), peer_packages("sb3-contrib")]


def test_a_changed_pin_or_another_python_makes_it_anew(made, monkeypatch, tmp_path):
    peer_python("sbx", tmp_path)
    monkeypatch.setitem(PINS, "sbx", ("sbx-rl==0.0.1",))
    peer_python("sbx", tmp_path)
    assert made[-1][0] == "sbx-rl==0.0.1" and len(made) == 2
    marker = tmp_path / ".venv-sbx" / MARKER
    current = f"python {sys.version_info.major}.{sys.version_info.minor}\n"
    assert marker.read_text("utf-8").startswith(current)
    marker.write_text(marker.read_text("utf-8").replace(current, "python 3.1\n"), "utf-8")
    peer_python("sbx", tmp_path)
    assert len(made) == 3


def test_why_an_environment_cannot_be_made_is_told_in_one_line(monkeypatch, tmp_path):
    failed = subprocess.CalledProcessError(1, ["pip"], stderr="a\nERROR: No matching distribution\n")
    monkeypatch.setattr(peers, "_make", Mock(side_effect=failed))
    with pytest.raises(PeerError, match=r"^sbx: got ERROR: No matching distribution, expected .*\.venv-sbx$"):
        peer_python("sbx", tmp_path)
    assert not (tmp_path / ".venv-sbx" / MARKER).exists()
