"""Errors of a run and of a calibration in the view, without a browser."""

import json

import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm._support.errors import InputError
from mjx_softarm.logs.pose_pairs import POSES_FILE, PosePairs, read_pose_pairs, write_pose_pairs

pytest.importorskip("viser", reason="needs viser: pip install -e '.[view]'")
from mjx_softarm.view.errors import Errors

SPEC = ArmSpec.default()


def pairs(off_mm, n=20):
    target = np.random.default_rng(0).normal([0.0, 0.0, -500.0, 0.0, 0.0, 0.0], 50.0, (n, 6))
    return PosePairs(target, target + [off_mm, 0.0, 0.0, 0.0, 0.0, 9.0], np.arange(n) < 3)


@pytest.fixture
def run(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"spec": SPEC.to_dict()}))
    return tmp_path


def test_sets_come_back_and_others_are_refused(tmp_path):
    sets = {"goals": pairs(3.0), "circle": pairs(1.0, n=4)}
    write_pose_pairs(tmp_path, sets)
    found = read_pose_pairs(tmp_path)
    assert list(found) == ["goals", "circle"] and [path.name for path in tmp_path.iterdir()] == [POSES_FILE]
    np.testing.assert_array_equal(found["circle"].pose, sets["circle"].pose)
    np.testing.assert_allclose(found["goals"].error_mm, 3.0)
    np.savez(tmp_path / POSES_FILE, **{"goals.target": np.zeros((3, 6))})
    for content in (None, b"PK\x03\x04", b"", b"time [s]"):
        if content is not None:
            (tmp_path / POSES_FILE).write_bytes(content)
        with pytest.raises(InputError, match="expected sets of poses"):
            read_pose_pairs(tmp_path)
    write_pose_pairs(tmp_path, {"goals": pairs(1.0)._replace(warned=np.zeros(3, bool))})
    with pytest.raises(InputError, match=r"goals: got shapes .*, expected \(n, 6\)"):
        read_pose_pairs(tmp_path)


def test_run_is_followed_from_before_its_first_evaluation(server, run):
    page = Errors(server, run)
    page.refresh()
    assert "waiting for the first evaluation" in page._text.content
    figures = {"evaluation/median_mm": 7.0, "evaluation/circle_mean_mm": 1.0}
    rows = [{"env_steps": 1} | figures, {"env_steps": 2} | figures]
    write_pose_pairs(run, {"goals": pairs(3.0)})
    (run / "metrics.jsonl").write_text(json.dumps(rows[0]) + '\n{"env_steps": 1}\n{"env_')
    page.refresh()
    assert "goals</b>: median 3.00 mm" in page._text.content and "3 marked" in page._text.content
    np.testing.assert_array_equal(page._curve.data, [[1.0], [7.0], [1.0]])
    write_pose_pairs(run, {"goals": pairs(1.5), "circle": pairs(0.5)})
    (run / "metrics.jsonl").write_text("\n".join(map(json.dumps, rows)))
    page.refresh()
    assert "median 1.50 mm" in page._text.content and "circle</b>: median 0.50" in page._text.content
    np.testing.assert_array_equal(page._curve.data, [[1.0, 2.0], [7.0, 7.0], [1.0, 1.0]])
    assert list(page._boxes) == ["goals", "circle"]


def test_calibration_is_shown(server, tmp_path):
    SPEC.to_toml(tmp_path / "arm.toml")
    page = Errors(server, tmp_path)
    page.refresh()
    assert f"no {POSES_FILE} here: the logs had no poses" in page._text.content
    write_pose_pairs(tmp_path, {"simulated": pairs(30.0), "with the network": pairs(2.0)})
    page.refresh()
    assert "the network extrapolates" in page._text.content and not hasattr(page, "_curve")
    hidden = [name for name, node in server.scene._handle_from_node_name.items() if not node.visible]
    assert {"/arm/tip/payload", "/arm/goal", "/arm/seen"} <= set(hidden)
