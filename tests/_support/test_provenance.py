"""Provenance of a result: its commit, and whether its code is committed."""

import subprocess

import pytest

from mjx_softarm._support import provenance as module
from mjx_softarm._support.provenance import provenance


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A commit of a package and of a result, in which this package seems to lie."""
    for name in ("package/code.py", "docs/results/a.json"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text("1")
    who = ("-c", "user.name=a", "-c", "user.email=a@b")
    for command in (("init", "-q"), ("add", "."), (*who, "commit", "-q", "-m", "a")):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    monkeypatch.setattr(module, "__file__", str(tmp_path / "package" / "code.py"))
    return tmp_path


def test_code_that_is_not_committed_is_told_and_other_results_are_not(checkout):
    assert provenance("a")["uncommitted_changes"] is False
    (checkout / "docs/results/a.json").write_text("2")
    (checkout / "docs/results/b.json").write_text("2")
    assert provenance("a")["uncommitted_changes"] is False
    (checkout / "package/code.py").write_text("2")
    assert provenance("a")["uncommitted_changes"] is True


def test_without_a_repository_of_the_package_there_is_no_commit(checkout, tmp_path_factory, monkeypatch):
    """Another repository around an installed package, and none at all."""
    (checkout / "installed.py").write_text("1")
    nowhere = tmp_path_factory.mktemp("nowhere")
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(nowhere.parent))
    for file in (checkout / "installed.py", nowhere / "code.py"):
        monkeypatch.setattr(module, "__file__", str(file))
        assert provenance("a")["commit"] is None and provenance("a")["uncommitted_changes"] is None
