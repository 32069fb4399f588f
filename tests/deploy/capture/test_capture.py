"""Motion capture over the loopback: poses, markers, names and commands, against servers of the tests' own."""

import json
import re

import numpy as np
import pytest

from calib.read.logs import read_log
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.__main__ import main
from mjx_softarm.deploy.capture import Delay, with_capture
from mjx_softarm.policy.file import save_policy
from mjx_softarm.sensing.pose import pose_error, pose_from_quaternion
from tests.deploy.capture.conftest import Arm
from tests.deploy.capture.scene import MARKERS_M, POSE, SPEC, look, scene_of
from tests.deploy.capture.servers import NatNetServer, Scene
from tests.linear_arm import POLICY, REST_M, SENSOR


@pytest.mark.parametrize(
    ("system", "options", "up", "base"),
    [
        ("natnet", {"version": (3, 1)}, "", True),  # up=y, as Motive has it
        ("natnet", {"version": (4, 1)}, ",up=z", True),
        ("natnet", {"version": (3, 0)}, ",up=y", False),
        ("qualisys", {}, "", True),  # up=z
        ("qualisys", {}, ",up=y", False),
    ],
)
def test_poses_and_markers_come_in_the_base_frame(system, options, up, base, serve, opened):
    axis = up[-1:] or {"natnet": "y", "qualisys": "z"}[system]
    serve(system, scene_of(base=base, up=axis), **options)
    arm, _ = opened(f"{system}:127.0.0.1:tip{up},markers=arm" + ",base=base" * base)
    seen = look(arm)
    pose = pose_from_quaternion(seen.tip_m, seen.tip_quaternion)
    np.testing.assert_allclose(pose_error(pose, POSE), 0.0, atol=2e-3)
    np.testing.assert_allclose(seen.marker_m[[0, 2]], MARKERS_M[[0, 2]], atol=1e-6)
    assert np.isnan(seen.marker_m[1]).all() and arm.extra == "the driver's own"


def test_a_multicast_stream_is_found(serve, opened, monkeypatch):
    monkeypatch.setattr("mjx_softarm.deploy.capture.natnet.WAIT_S", 0.3)
    probe = NatNetServer(Scene({}))
    probe.socket.close()
    monkeypatch.setattr("mjx_softarm.deploy.capture.natnet.DATA_PORT", probe.port)
    serve("natnet", scene_of(), group=("239.255.42.99", probe.port))
    seen = look(opened("natnet:127.0.0.1:tip,base=base,up=z")[0])
    np.testing.assert_allclose(1e3 * seen.tip_m, POSE[:3], atol=1e-2)


@pytest.mark.parametrize(
    ("system", "rest", "message"),
    [
        ("natnet", "tp", "got no body 'tp', expected one of base, tip"),
        ("qualisys", "tp", "got no body 'tp', expected one of base, tip"),
        ("natnet", "tip,markers=spring", "got no marker set 'spring', expected one of arm"),
        ("qualisys", "tip,markers=a", "got no marker 'a0', expected one of arm2"),
        ("qualisys", "tip,base=base,up=y", "got the tip at .* expected it near 0, 0, -600 mm"),
        ("natnet", "tip,up=z", "got the tip at 1.* is the origin the base"),
    ],
)
def test_wrong_names_axes_and_origins_are_refused(system, rest, message, serve, opened):
    serve(system, scene_of())
    with pytest.raises(InputError, match=f"--capture {system}:127.0.0.1.*: {message}"):
        opened(f"{system}:127.0.0.1:{rest}")


def test_an_arm_that_stands_is_seen_above_its_base(serve, opened):
    spec = SPEC.replace(mounting={"base_turn_deg": [180.0, 0.0, 0.0]})
    standing = np.array([0.0, 0.0, 600.0, 0.0, 0.0, 180.0])
    serve("qualisys", scene_of(standing, base=False))
    seen = look(opened("qualisys:127.0.0.1:tip", spec)[0])
    np.testing.assert_allclose(1e3 * seen.tip_m, standing[:3], atol=1e-2)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("vicon:host:tip", "expected natnet:HOST:BODY or qualisys:HOST:BODY"),
        ("natnet:host:tip,left=x", "expected natnet:HOST:BODY or qualisys:HOST:BODY"),
        ("natnet:host:tip,base=b,markers=", "expected natnet:HOST:BODY or qualisys:HOST:BODY"),
        ("natnet:host:tip,up=x", "got up=x, expected y or z"),
        ("natnet:host:tip", "natnet:host:tip: got an arm with its own motion capture"),
    ],
)
def test_names_that_are_refused(name, message):
    own = type("Own", (Arm,), {"motion_capture": lambda self: None})()
    with pytest.raises(InputError, match=message):
        with_capture(own, name, SPEC, print)


def test_delay_ignores_the_clocks_difference_and_their_slow_drift():
    delay = Delay()
    for k in range(100_000):  # 1000 s; the server's clock loses 100 ppm
        now_s = 0.01 * k
        delay_s = delay.measure(5e6 + now_s * (1.0 - 1e-4), now_s)
    assert delay_s < 1e-3
    assert delay.measure(5e6 + now_s * (1.0 - 1e-4), now_s + 0.2) == pytest.approx(0.2, abs=2e-3)
    assert delay.measure(3.0, now_s + 0.21) == 0.0  # the clock begins anew


DRIVER = """
import time
import numpy as np

class Arm:
    def read_sensors(self):
        return np.full(9, {readings}) + np.random.default_rng(time.monotonic_ns()).normal(0, 300, 9)
    def write_pressures(self, pressure_kpa):
        pass
"""
TIP_M = np.array([0.01, -0.02, -0.55])


def test_commands_take_motion_capture(serve, tmp_path, monkeypatch, capsys):
    """The arm, which keeps real time, never leaves a place that is not that of an arm without air."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "seen.py").write_text(DRIVER.format(readings=SENSOR.readings(np.full(9, REST_M - 0.02))[0]))
    save_policy(tmp_path / "policy.npz", POLICY)
    goal = ",".join(map(str, POLICY.workspace[0]))
    (tmp_path / "goals.csv").write_text(f"x [mm],y [mm],z [mm],yaw [deg],pitch [deg],roll [deg]\n{goal}\n")
    serve("qualisys", scene_of(np.append(1e3 * TIP_M, np.zeros(3)), hidden=[]))
    on = ["--arm", "seen:Arm", "--capture", "qualisys:127.0.0.1:tip,base=base,up=z,markers=arm"]

    assert main(["run", "policy.npz", *on, f"--goal={goal}", "--duration", "0.5", "--log", "run.csv"]) == 1
    assert main(["measure", "policy.npz", *on, "--out", "a", "--goals", "goals.csv"]) == 1
    assert main(["record", *on, "--out", "b.npz", "--poses", "1"]) == 0
    told = capsys.readouterr().out
    assert len(re.findall(r"motion capture: the tip was seen in \d+ of \d+ ticks", told)) == 3
    assert "mm off by motion capture; yaw" in told and "tip and markers are missing" not in told
    found = json.loads((tmp_path / "a" / "accuracy.json").read_text())
    assert found["translation_mm"] == pytest.approx(np.linalg.norm(POLICY.workspace[0][:3] - 1e3 * TIP_M))
    for name in ("run.csv", "b.npz"):
        log = read_log(tmp_path / name)[0]
        np.testing.assert_allclose(np.nanmean(log.tip_m, axis=0), TIP_M, atol=1e-5)
        np.testing.assert_allclose(np.nanmean(log.marker_m, axis=0), MARKERS_M, atol=1e-5)
