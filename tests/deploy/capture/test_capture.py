"""Motion capture over the loopback: poses, markers, and faults, against servers of the tests' own."""

import json
import re
import socket
import time

import numpy as np
import pytest

from calib.read.logs import read_log
from mjx_softarm import ArmSpec
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy import capture
from mjx_softarm.deploy.__main__ import main
from mjx_softarm.deploy.capture import Delay, with_capture
from mjx_softarm.deploy.capture.system import CaptureName
from mjx_softarm.policy.file import save_policy
from mjx_softarm.sensing.pose import frame_from_pose, pose_error, pose_from_quaternion
from tests.deploy.capture.servers import NatNetServer, QualisysServer, Scene
from tests.linear_arm import POLICY, REST_M, SENSOR

SPEC = ArmSpec.default()
POSE = np.array([30.0, -40.0, -570.0, 12.0, -8.0, 5.0])
MARKERS_M = np.array([[0.05, 0.0, -0.2], [0.0, 0.05, -0.4], [-0.05, 0.01, -0.55]])
BASE_M, TURN = np.array([1.0, -0.5, 2.0]), frame_from_pose(np.array([0, 0, 0, 90.0, 3.0, -2.0]))[1]
SYSTEMS = ["natnet", "qualisys"]


class Arm:
    extra = "the driver's own"

    def read_sensors(self):
        return np.ones(9)


def to_y_up(x):
    """(x, y, z) of a frame whose z points up, where y points up."""
    return np.stack([x[..., 0], x[..., 2], -x[..., 1]], axis=-1)


def scene_of(pose=POSE, base=True, up="z", hidden=1):
    """The arm at a pose in its base frame, as a system sees it whose axes differ."""
    at_m, axes = frame_from_pose(pose)
    base_m, turn = (BASE_M, TURN) if base else (np.zeros(3), np.eye(3))
    poses = {"base": (base_m, turn), "tip": (base_m + turn @ at_m, turn @ axes)}
    markers_m = base_m + MARKERS_M @ turn.T
    markers_m[hidden] = np.nan
    if up == "y":
        change = to_y_up(np.eye(3)).T  # columns are the old axes in the new ones
        poses = {name: (to_y_up(at), change @ axes @ change.T) for name, (at, axes) in poses.items()}
        markers_m = to_y_up(markers_m)
    return Scene(poses, markers_m)


@pytest.fixture
def serve(monkeypatch, request):
    """Return what starts a server of a system, on a port of its own."""

    def make(system, scene, **options):
        module = pytest.importorskip(
            {"natnet": "natnet", "qualisys": "qtm_rt"}[system], reason="pip install -e '.[capture]'"
        )
        assert module
        server = (NatNetServer if system == "natnet" else QualisysServer)(scene, **options)
        port = "natnet.COMMAND_PORT" if system == "natnet" else "qualisys.PORT"
        monkeypatch.setattr(f"mjx_softarm.deploy.capture.{port}", server.port)
        request.addfinalizer(lambda: server.__exit__())
        return server.__enter__()

    return make


@pytest.fixture
def opened(request):
    """Return what opens an arm with motion capture, and lines that it tells."""

    def make(name, spec=SPEC):
        lines = []
        arm = with_capture(Arm(), name, spec, lines.append)
        request.addfinalizer(arm._source.close)
        return arm, lines

    return make


def look(arm, tries=200):
    """Return the next frame that is not missed."""
    seen = set()
    for _ in range(tries):
        try:
            return arm.motion_capture()
        except OSError as error:
            seen.add(str(error))
            time.sleep(0.005)
    raise AssertionError(f"no frame came: {seen}")


def missed(arm, message, tries=200):
    """Wait for a frame that is missed for this reason."""
    seen = []
    for _ in range(tries):
        try:
            arm.motion_capture()
        except OSError as error:
            seen.append(str(error))
            if re.search(message, seen[-1]):
                return
        time.sleep(0.005)
    raise AssertionError({*seen})


@pytest.mark.parametrize(
    ("system", "options", "up", "base"),
    [
        ("natnet", {"version": (3, 1)}, "y", True),
        ("natnet", {"version": (4, 1)}, "z", True),
        ("natnet", {"version": (3, 0)}, "y", False),
        ("qualisys", {}, "z", True),
        ("qualisys", {}, "y", False),
    ],
)
def test_poses_and_markers_come_in_the_base_frame(system, options, up, base, serve, opened):
    serve(system, scene_of(base=base, up=up), **options)
    arm, _ = opened(f"{system}:127.0.0.1:tip,up={up},markers=arm" + ",base=base" * base)
    seen = look(arm)
    pose = pose_from_quaternion(seen.tip_m, seen.tip_quaternion)
    np.testing.assert_allclose(pose_error(pose, POSE), 0.0, atol=2e-3)
    np.testing.assert_allclose(seen.marker_m[[0, 2]], MARKERS_M[[0, 2]], atol=1e-6)
    assert np.isnan(seen.marker_m[1]).all() and arm.extra == "the driver's own"


def test_axes_are_those_of_the_system_unless_named(serve, opened):
    serve("natnet", scene_of(up="y"))
    seen = look(opened("natnet:127.0.0.1:tip,base=base")[0])
    np.testing.assert_allclose(1e3 * seen.tip_m, POSE[:3], atol=1e-2)
    assert seen.marker_m.shape == (0, 3)


def test_a_multicast_stream_is_found(serve, opened, monkeypatch):
    monkeypatch.setattr("mjx_softarm.deploy.capture.natnet.WAIT_S", 0.3)
    probe = NatNetServer(Scene({}))
    probe.socket.close()
    monkeypatch.setattr("mjx_softarm.deploy.capture.natnet.DATA_PORT", probe.port)
    serve("natnet", scene_of(), group=("239.255.42.99", probe.port))
    seen = look(opened("natnet:127.0.0.1:tip,base=base,up=z")[0])
    np.testing.assert_allclose(1e3 * seen.tip_m, POSE[:3], atol=1e-2)


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_lost_body_is_a_gap_that_is_told(system, serve, opened, monkeypatch):
    scene = scene_of()
    serve(system, scene)
    arm, lines = opened(f"{system}:127.0.0.1:tip,base=base,up=z")
    look(arm)
    scene.hidden = {"base"}  # which does not move
    for _ in range(10):
        np.testing.assert_allclose(1e3 * look(arm).tip_m, POSE[:3], atol=1e-2)
    scene.hidden = {"tip"}
    missed(arm, "got a frame without the body 'tip'")
    monkeypatch.setattr(capture, "LOST_S", 0.05)
    while not lines:
        missed(arm, "'tip'")
    monkeypatch.undo()
    scene.hidden = set()
    look(arm)
    assert re.fullmatch("motion capture: lost: got .*", lines[0])
    assert re.fullmatch(r"motion capture: back after \d+\.\d s", lines[1]) and len(lines) == 2
    text = arm.finish()
    assert re.search(r"the tip was seen in \d+ of \d+ ticks; .*at most \d+ ms later", text)
    assert ("sent 4.0 ms after the exposure" in text) == (system == "natnet")


@pytest.mark.parametrize("system", SYSTEMS)
def test_late_frames_are_missed(system, serve, opened):
    scene = scene_of()
    serve(system, scene)
    arm, _ = opened(f"{system}:127.0.0.1:tip,base=base,up=z")
    look(arm)
    scene.held = True  # frames are made but not sent
    missed(arm, "got no new frame from 127.0.0.1")
    time.sleep(0.1)
    scene.mute = True  # none is made from now on
    time.sleep(0.2)
    scene.held = False
    missed(arm, r"got a frame \d+ ms late, expected 50 at most")
    scene.mute = False
    look(arm)


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_server_that_goes_does_not_hold_up_the_loop_and_may_come_back(system, serve, opened, monkeypatch):
    monkeypatch.setattr(f"mjx_softarm.deploy.capture.{system}.AGAIN_S", 0.05)
    monkeypatch.setattr(capture, "LOST_S", 0.05)
    server = serve(system, scene_of())
    arm, _ = opened(f"{system}:127.0.0.1:tip,base=base,up=z")
    look(arm)
    server.__exit__()
    missed(arm, "got no new frame" if system == "natnet" else "got an end of the connection")
    begin_s = time.monotonic()
    for _ in range(100):
        with pytest.raises(OSError):
            arm.motion_capture()
    assert time.monotonic() - begin_s < 100 * 0.02
    scene = scene_of()
    scene.bodies = dict(reversed(scene.bodies.items()))  # they have other numbers now
    again = serve(system, scene, **({"port": server.port} if system == "qualisys" else {}))
    if system == "natnet":  # the same port is asked
        arm._source._client._NatNetClient__command_port = again.port
    np.testing.assert_allclose(1e3 * look(arm, 1000).tip_m, POSE[:3], atol=1e-2)


def test_a_body_that_the_system_does_not_describe_is_no_base(serve, opened):
    scene = scene_of(base=False)
    scene.bodies["ghost"], scene.unnamed = (np.ones(3), np.eye(3)), {"ghost"}
    serve("natnet", scene)
    arm, _ = opened("natnet:127.0.0.1:tip,up=z")
    for _ in range(5):
        np.testing.assert_allclose(1e3 * look(arm).tip_m, POSE[:3], atol=1e-2)


@pytest.mark.parametrize("system", SYSTEMS)
def test_frames_that_queued_up_are_not_taken_for_new_ones(system, serve, opened, monkeypatch):
    monkeypatch.setattr("mjx_softarm.deploy.capture.natnet.AGAIN_S", 100.0)
    monkeypatch.setattr(capture, "LOST_S", 0.2)
    scene = scene_of(base=False)
    serve(system, scene)
    arm, _ = opened(f"{system}:127.0.0.1:tip,up=z")
    look(arm)
    for _ in range(2):
        time.sleep(0.5)  # 100 frames
        place_m, axes = scene.bodies["tip"]
        scene.bodies["tip"] = place_m + 0.01, axes
        time.sleep(0.05)
        np.testing.assert_allclose(look(arm).tip_m, place_m + 0.01, atol=1e-5)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [("bodies", "got no body 'tip', expected one of base"), ("version", "got the answer .*Parse error")],
)
def test_a_server_that_comes_back_wrong_is_told_why_and_asked_on(wrong, message, serve, opened, monkeypatch):
    """The host is looked up once. A connection that is of no use is closed."""
    monkeypatch.setattr("mjx_softarm.deploy.capture.qualisys.AGAIN_S", 0.05)
    monkeypatch.setattr(capture, "LOST_S", 0.05)
    server = serve("qualisys", scene_of())
    arm, _ = opened("qualisys:localhost:tip,base=base,up=z")
    look(arm)
    server.__exit__()
    asked = []
    monkeypatch.setattr(socket, "getaddrinfo", lambda *args, **_: asked.append(args))
    again = QualisysServer(scene_of(), port=server.port)
    bodies = again.scene.bodies
    if wrong == "bodies":
        again.scene.bodies = {"base": bodies["base"]}
    else:
        again.refuses = wrong
    with again:
        for n in (2, 4):
            while again.n_dropped < n:
                missed(arm, f"got an end of the connection by localhost.*{message}")
        assert again.n_accepted - again.n_dropped <= 1
        again.scene.bodies, again.refuses = bodies, ""
        np.testing.assert_allclose(1e3 * look(arm, 1000).tip_m, POSE[:3], atol=1e-2)
        assert not asked


@pytest.mark.parametrize(
    ("system", "rest", "message"),
    [
        ("natnet", "tp", r"got no body 'tp', expected one of base, tip"),
        ("qualisys", "tp", r"got no body 'tp', expected one of base, tip"),
        ("qualisys", "tip,base=b", r"got no body 'b', expected one of base, tip"),
        ("natnet", "tip,markers=spring", r"got no marker set 'spring', expected one of arm"),
        ("qualisys", "tip,markers=a", r"got no marker 'a0', expected one of arm2, arm1, arm0, other"),
        (
            "qualisys",
            "tip,base=base,up=y",
            r"got the tip at .* expected it near 0, 0, -600 mm, .*up=y or up=z",
        ),
        ("natnet", "tip,up=z", r"got the tip at 1\d+, .* is the origin the base"),
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


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_body_that_is_not_seen_at_first_is_refused(system, serve, opened):
    scene = scene_of()
    scene.hidden = {"tip"}
    serve(system, scene)
    with pytest.raises(InputError, match="got .*'tip', expected one with the tip within 1 s"):
        opened(f"{system}:127.0.0.1:tip,base=base,up=z")


def test_servers_that_do_not_answer_are_named(serve, opened, monkeypatch):
    for system in SYSTEMS:
        monkeypatch.setattr(f"mjx_softarm.deploy.capture.{system}.WAIT_S", 0.2)
        server = serve(system, scene_of())
        server.scene.mute = True
        with pytest.raises(InputError, match=f"--capture {system}:.*got no .*frame from 127.0.0.1"):
            opened(f"{system}:127.0.0.1:tip")
        server.__exit__()
        with pytest.raises(InputError, match=f"--capture {system}:.*got no (answer|connection)"):
            opened(f"{system}:127.0.0.1:tip")


def test_packets_that_cannot_be_read_are_gaps(serve, opened, monkeypatch):
    scene = scene_of()
    server = serve("natnet", scene)
    arm, _ = opened("natnet:127.0.0.1:tip,base=base,up=z")
    whole = server.frame
    monkeypatch.setattr(server, "frame", lambda *args: whole(*args)[:90])
    missed(arm, "got a packet that cannot be read")
    monkeypatch.undo()
    server.frame = whole
    look(arm)


@pytest.mark.parametrize(
    "name",
    [
        "natnet",
        "vicon:host:tip",
        "natnet:host",
        "qualisys::tip",
        "natnet:host:tip,left=x",
        "natnet:host:tip,base",
        "natnet:host:tip,base=b,markers=",
    ],
)
def test_malformed_names(name):
    with pytest.raises(InputError, match="expected natnet:HOST:BODY or qualisys:HOST:BODY"):
        CaptureName.read(name)


def test_up_is_y_or_z_and_an_arm_has_one_motion_capture():
    with pytest.raises(InputError, match="got up=x, expected y or z"):
        CaptureName.read("natnet:host:tip,up=x")
    own = type("Own", (Arm,), {"motion_capture": lambda self: None})()
    with pytest.raises(InputError, match="an arm with its own motion capture"):
        with_capture(own, "natnet:host:tip", SPEC, print)
    assert with_capture(own, None, SPEC, print) is own


def test_delay_ignores_the_clocks_difference_and_their_slow_drift():
    delay = Delay()
    for k in range(100_000):  # 1000 s; the server's clock loses 100 ppm
        now_s = 0.01 * k
        found_s = delay.of(5e6 + now_s * (1.0 - 1e-4), now_s)
    assert found_s < 1e-3
    assert delay.of(5e6 + now_s * (1.0 - 1e-4), now_s + 0.2) == pytest.approx(0.2, abs=2e-3)
    assert delay.of(3.0, now_s + 0.21) == 0.0  # the clock begins anew


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


@pytest.mark.parametrize("system", SYSTEMS)
def test_commands_take_motion_capture(system, serve, tmp_path, monkeypatch, capsys):
    """The arm, which keeps real time, never leaves its place."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / f"on_{system}.py").write_text(DRIVER.format(readings=SENSOR.readings(np.full(9, REST_M))[0]))
    save_policy(tmp_path / "policy.npz", POLICY)
    goal = ",".join(map(str, POLICY.workspace[0]))
    (tmp_path / "goals.csv").write_text(f"x [mm],y [mm],z [mm],yaw [deg],pitch [deg],roll [deg]\n{goal}\n")
    serve(system, scene_of(np.append(1e3 * TIP_M, np.zeros(3)), hidden=[]))
    on = ["--arm", f"on_{system}:Arm", "--capture", f"{system}:127.0.0.1:tip,base=base,up=z,markers=arm"]

    assert main(["run", "policy.npz", *on, f"--goal={goal}", "--duration", "0.5", "--log", "run.csv"]) == 1
    assert main(["measure", "policy.npz", *on, "--out", "a", "--goals", "goals.csv"]) == 1
    assert main(["record", *on, "--out", "b.npz", "--poses", "1", "--transients"]) == 0
    told = capsys.readouterr().out
    assert len(re.findall(r"motion capture: the tip was seen in \d+ of \d+ ticks", told)) == 3
    assert "mm off by motion capture; yaw" in told and "tip and markers are missing" not in told
    found = json.loads((tmp_path / "a" / "accuracy.json").read_text())
    assert found["translation_mm"] == pytest.approx(np.linalg.norm(POLICY.workspace[0][:3] - 1e3 * TIP_M))
    for name in ("run.csv", "b.npz"):
        log = read_log(tmp_path / name)[0]
        np.testing.assert_allclose(np.nanmean(log.tip_m, axis=0), TIP_M, atol=1e-5)
        np.testing.assert_allclose(np.nanmean(log.marker_m, axis=0), MARKERS_M, atol=1e-5)
