"""`python -m train export RUN --onnx --cpp DIR`: which files it writes, and what it refuses."""

from types import SimpleNamespace

import pytest

from mjx_softarm._support.errors import InputError
from mjx_softarm.export.golden import read_golden
from tests.export.conftest import few_golden_rows
from train.runs import arm_model
from train.runs import export as command


def test_files_of_an_export(policy_file, tmp_path, monkeypatch, capsys):
    pytest.importorskip("onnx", reason="the package onnx is not installed")
    policy = tmp_path / "policy.npz"
    policy.write_bytes(policy_file.read_bytes())
    monkeypatch.setattr(command, "export_run", lambda run, arm, out: policy)
    monkeypatch.setattr(arm_model, "arm_model", lambda *arguments: None)
    monkeypatch.setattr(command, "actor_of", lambda run: None)
    run = SimpleNamespace(arm=None)
    monkeypatch.setattr(command.Run, "open", lambda path: run)
    with few_golden_rows():
        assert command.export((tmp_path,), onnx=True, cpp=tmp_path / "cpp") == 0
    beside = {path.name for path in tmp_path.iterdir()}
    graphs = {f"policy{of}.onnx" for of in ("", "_actor", "_check")}
    assert beside == graphs | {"policy.npz", "policy_golden.csv", "cpp"}
    names = {path.name for path in (tmp_path / "cpp").iterdir()}
    assert names == {"softarm.hpp", "rows.cpp", "example.cpp", "CMakeLists.txt", "golden.csv"}
    assert names | beside - {"cpp"} <= {
        line.split("/")[-1].split(",")[0] for line in capsys.readouterr().out.splitlines()
    }
    golden = read_golden(tmp_path / "cpp" / "golden.csv")
    assert golden.about["policy_sha256"] in (tmp_path / "cpp" / "softarm.hpp").read_text()


def test_one_folder_holds_one_policy(tmp_path):
    with pytest.raises(InputError, match="RUN: got 2, expected one folder of a run"):
        command.export((tmp_path, tmp_path), cpp=tmp_path / "cpp")
