"""The arm as a motion capture system sees it, and ways to look at it."""

import re
import time

import numpy as np

from mjx_softarm import ArmSpec
from mjx_softarm.sensing.pose import frame_from_pose
from tests.deploy.capture.servers import Scene

SPEC = ArmSpec.default()
POSE = np.array([30.0, -40.0, -570.0, 12.0, -8.0, 5.0])
MARKERS_M = np.array([[0.05, 0.0, -0.2], [0.0, 0.05, -0.4], [-0.05, 0.01, -0.55]])
BASE_M, TURN = np.array([1.0, -0.5, 2.0]), frame_from_pose(np.array([0, 0, 0, 90.0, 3.0, -2.0]))[1]
SYSTEMS = ["natnet", "qualisys"]


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
