"""The page in a real browser."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from calib.read.logs import read_log
from mjx_softarm.logs.schema import write_log
from mjx_softarm.policy.file import save_policy
from tests.linear_arm import GOALS, POLICY, SPEC, LinearArm, go

ROOT = Path(__file__).resolve().parents[2]
WIDTH, HEIGHT = 1000, 700


def pixel(point_m):
    """Pixel at which the first camera draws a point, with 75 degrees from top to bottom."""
    length_m = 3 * SPEC.geometry.section_length_m + SPEC.mass.gripper_length_m
    eye, at = length_m * np.array([1.35, -0.675, -0.3]), length_m * np.array([0, 0, -0.55])
    ahead = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(np.cross(ahead, [0, 0, 1]))
    x, y, z = np.stack([right, np.cross(right, ahead), ahead]) @ (point_m - eye)
    scale = 0.5 * HEIGHT / np.tan(np.radians(75) / 2) / z
    return WIDTH / 2 + scale * x, HEIGHT / 2 - scale * y


def says(page, text):
    page.wait_for_function(f"document.body.innerText.includes({text!r})", timeout=60_000)


def press(page, name):
    """Click without waiting for pictures, which a processor draws slowly."""
    page.get_by_role("button", name=name).dispatch_event("click")


def tip_m(page):
    words = page.inner_text("body").partition("tip at ")[2].partition(" mm")[0]
    return 1e-3 * np.array(words.split(","), float)


@pytest.fixture
def live(tmp_path):
    """A running view of the linear arm, its address and its log."""
    save_policy(tmp_path / "policy.npz", POLICY)
    words = ("--policy", tmp_path / "policy.npz", "--arm", "tests.linear_arm:LinearArm", "--port", "8210")
    command = [sys.executable, "-m", "mjx_softarm.view", *words, "--log", tmp_path / "run.csv"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        line = process.stdout.readline()
        yield process, line.split()[1].rstrip(";"), tmp_path / "run.csv"
        process.kill()


def test_goal_is_dragged_and_the_arm_stopped_and_vented(browser, live):
    process, address, path = live
    page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
    page.goto(address)
    says(page, "The arm moves")  # a simulated arm begins by itself
    press(page, "Stop")
    says(page, "The arm holds")
    press(page, "Drag the goal")
    page.wait_for_selector("canvas")
    page.wait_for_timeout(3000)  # the gizmo is drawn
    before_m = tip_m(page)
    x, y = pixel(before_m + [0, 0, 0.11])  # the upward arrow
    page.mouse.move(x, y)
    page.wait_for_timeout(500)
    page.mouse.down()
    for k in range(10):
        page.mouse.move(x, y - 6 * k)
        page.wait_for_timeout(50)
    page.mouse.up()
    says(page, "from the goal, as estimated")
    press(page, "Vent")
    says(page, "The arm has no pressure")
    page.close()
    assert any("no page is open; the arm has no pressure" in line for line in process.stdout)
    process.send_signal(signal.SIGTERM)
    assert process.wait(20) == 128 + signal.SIGTERM
    goal = read_log(path)[0].goal
    dragged = goal[np.isfinite(goal[:, 0]) & (np.abs(goal[:, 0] - goal[0, 0]) > 1e-6)]
    assert dragged[-1, 2] > 1e3 * before_m[2] + 10.0  # [mm]


def test_shared_file_plays_without_a_server(browser, tmp_path):
    from mjx_softarm.view.replay import Timeline, share

    write_log(tmp_path / "run.csv", go(LinearArm(), goals=GOALS[:1], duration_s=2.0).log)
    share(tmp_path / "run.html", SPEC, [Timeline(tmp_path / "run.csv", SPEC)])
    context = browser.new_context(offline=True, viewport={"width": 500, "height": 400})
    page, errors = context.new_page(), []
    page.on("pageerror", lambda error: errors.append(error))
    page.goto((tmp_path / "run.html").as_uri())
    page.wait_for_selector("canvas")
    later = "Number(document.querySelector('input').value) > 0.3"  # of the time at the foot of the page
    page.wait_for_function(later, timeout=60_000)
    assert not errors
    context.close()
