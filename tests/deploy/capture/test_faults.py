"""Faults of motion capture: bodies lost, frames late, servers that go and come back, packets in pieces."""

import re
import time

import numpy as np
import pytest

from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy import capture
from tests.deploy.capture.scene import POSE, SYSTEMS, look, missed, scene_of
from tests.deploy.capture.servers import QualisysServer


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
    assert re.search(r"the tip was seen in \d+ of \d+ ticks; at most \d+ ms later", arm.finish())


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


def test_a_server_that_comes_back_wrong_is_asked_on(serve, opened, monkeypatch):
    """A connection that is of no use is closed."""
    monkeypatch.setattr("mjx_softarm.deploy.capture.qualisys.AGAIN_S", 0.05)
    monkeypatch.setattr(capture, "LOST_S", 0.05)
    server = serve("qualisys", scene_of())
    arm, _ = opened("qualisys:localhost:tip,base=base,up=z")
    look(arm)
    server.__exit__()
    again = QualisysServer(scene_of(), port=server.port)
    bodies = again.scene.bodies
    with again:
        for n, wrong, message in (
            (2, {"refuses": "version"}, "got the answer .*Parse error"),
            (4, {"bodies": {"base": bodies["base"]}}, "got no body 'tip', expected one of base"),
        ):
            again.refuses = wrong.get("refuses", "")
            again.scene.bodies = wrong.get("bodies", bodies)
            while again.n_dropped < n:
                missed(arm, "got an end of the connection by localhost")
            missed(arm, f"got an end of the connection by localhost.*{message}")
        assert again.n_accepted - again.n_dropped <= 1
        again.scene.bodies = bodies
        np.testing.assert_allclose(1e3 * look(arm, 1000).tip_m, POSE[:3], atol=1e-2)


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_body_that_is_not_seen_at_first_is_refused(system, serve, opened):
    scene = scene_of()
    scene.hidden = {"tip"}
    serve(system, scene)
    with pytest.raises(InputError, match="got .*'tip', expected a frame with the tip within 1 s"):
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
