"""Faults of motion capture: bodies lost, frames late, servers that go and come back, packets in pieces."""

import re
import time

import numpy as np
import pytest

from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy import capture
from tests.deploy.capture.scene import POSE, SYSTEMS, look, missed, scene_of


@pytest.fixture(params=SYSTEMS)
def watched(request, serve, opened):
    """A system's scene, the arm in it, which was seen, and lines that it tells."""
    scene = scene_of()
    serve(request.param, scene)
    arm, lines = opened(f"{request.param}:127.0.0.1:tip,base=base,up=z")
    look(arm)
    return scene, arm, lines


def test_a_lost_body_is_a_gap_that_is_told(watched, monkeypatch):
    scene, arm, lines = watched
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


def test_late_frames_are_missed(watched):
    scene, arm, _ = watched
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
def test_a_server_that_goes_does_not_hold_up_the_loop_and_motive_may_come_back(
    system, serve, opened, monkeypatch
):
    monkeypatch.setattr("mjx_softarm.deploy.capture.natnet.AGAIN_S", 0.05)
    server = serve(system, scene_of())
    arm, _ = opened(f"{system}:127.0.0.1:tip,base=base,up=z")
    look(arm)
    server.__exit__()
    missed(arm, "got no new frame" if system == "natnet" else "got an end of the connection by 127.0.0.1")
    begin_s = time.monotonic()
    for _ in range(100):
        with pytest.raises(OSError):
            arm.motion_capture()
    assert time.monotonic() - begin_s < 100 * 0.02
    if system == "natnet":  # the same port is asked
        scene = scene_of()
        scene.bodies = dict(reversed(scene.bodies.items()))  # they have other numbers now
        arm._source._client._NatNetClient__command_port = serve(system, scene).port
        np.testing.assert_allclose(1e3 * look(arm, 1000).tip_m, POSE[:3], atol=1e-2)


def test_a_body_that_the_system_does_not_describe_is_no_base(serve, opened):
    scene = scene_of(base=False)
    scene.bodies["ghost"], scene.unnamed = (np.ones(3), np.eye(3)), {"ghost"}
    serve("natnet", scene)
    arm, _ = opened("natnet:127.0.0.1:tip,up=z")
    for _ in range(5):
        np.testing.assert_allclose(1e3 * look(arm).tip_m, POSE[:3], atol=1e-2)


def test_frames_that_queued_up_are_not_taken_for_new_ones(watched, monkeypatch):
    monkeypatch.setattr("mjx_softarm.deploy.capture.natnet.AGAIN_S", 100.0)
    scene, arm, _ = watched
    place_m, axes = scene.bodies["tip"]
    before_m = look(arm).tip_m
    for k in (1, 2):
        time.sleep(0.5)  # 100 frames
        scene.bodies["tip"] = place_m + 0.01 * k, axes
        time.sleep(0.05)
        moved_m = np.linalg.norm(look(arm).tip_m - before_m)
        assert moved_m == pytest.approx(0.01 * k * 3**0.5, abs=1e-5)


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


def test_packets_that_cannot_be_read_are_gaps(serve, opened):
    server = serve("natnet", scene_of())
    arm, _ = opened("natnet:127.0.0.1:tip,base=base,up=z")
    whole = server.frame
    server.frame = lambda *args: whole(*args)[:90]
    missed(arm, "got a packet that cannot be read")
    server.frame = whole
    look(arm)
