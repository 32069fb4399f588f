"""Motion capture without code: `--capture natnet:HOST:BODY` or `--capture qualisys:HOST:BODY`.

BODY is the rigid body of the last plate. Options follow it, each after a comma:

    base=BODY     a rigid body fixed to the base; without it the system's own origin is the base's middle
    markers=NAME  markers along the arm, from the base to the tip: NatNet's marker set of this name, or
                  Qualisys' labels NAME0, NAME1, ... in the order of their numbers
    up=y          the system's y axis points up: NatNet's default, as in Motive; up=z is Qualisys' default

The system's x axis has to be the base's. Create the bodies while the arm is straight, so that both have the
system's axes then, and put their origins in the middle of the last plate and of the base: calibration fits
the few millimetres and degrees that remain.

The loop takes the newest frame of each tick and never waits for one. A frame is missed, which is a gap in the
log, where none is new, it is late, it is the first after a second without any, or a body is not seen in it.
The base does not move, so it keeps the place at which it was last seen. Frames are logged with the tick that
takes them, not shifted by their age.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.deploy.capture.natnet import NatNet
from mjx_softarm.deploy.capture.qualisys import Qualisys
from mjx_softarm.deploy.capture.system import UP, CaptureFrame, CaptureName
from mjx_softarm.deploy.link import describe, first_frame
from mjx_softarm.posture import straight_pose
from mjx_softarm.sensing.pose import (
    frame_from_pose,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_vector,
)
from mjx_softarm.spec import ArmSpec

LATE_S = 0.05  # delay, beyond that of the fastest frames, of a frame that is late; by hand
DRIFT = 1e-3  # largest difference of the two clocks' rates that is not taken for a delay; by hand
LOST_S = 1.0  # time without a frame after which motion capture counts as lost; by hand
MOST_POLLS = 50  # polls that pass over queued frames; they read more than a socket holds; by hand
# Largest distance of the tip from the end of the straight arm, in its lengths, and largest angle; by hand.
# Wrong axes are 1.4 lengths and 90 degrees off.
_NEAR = 0.5
_TURNED_DEG = 60.0
_KINDS = {"natnet": NatNet, "qualisys": Qualisys}


class Delay:
    """Delay of frames beyond that of the fastest, on two clocks that need not agree."""

    def __init__(self) -> None:
        self._offset_s = np.inf
        self._frame_s = -np.inf
        self._now_s = 0.0

    def measure(self, frame_s: float, now_s: float) -> float:
        """Return the delay [s] of a frame with a time [s] on its own clock, taken at a time [s] on ours."""
        # After a while without frames the system may have begun anew, and its clock with it.
        if frame_s < self._frame_s or now_s - self._now_s > LOST_S:
            self._offset_s = np.inf
        drifted_s = self._offset_s + DRIFT * (now_s - self._now_s)
        self._offset_s = min(drifted_s, now_s - frame_s)
        self._frame_s = frame_s
        self._now_s = now_s
        return now_s - frame_s - self._offset_s


class CapturedArm:
    """An arm whose motion capture is a system in the network; all else is the arm's own driver's.

    `tell` takes a line when the tip is lost for `LOST_S`, and when it is seen again.
    """

    def __init__(self, arm: Any, source: NatNet | Qualisys, name: CaptureName, tell: Callable[[str], None]):
        self._arm = arm
        self._source = source
        self._name = name
        self._tell = tell
        self._delay = Delay()
        self._seen_s = time.monotonic()
        self._lost = False
        self._polled_s = -np.inf  # time of the last frame, whatever it shows
        self._base: tuple[np.ndarray, np.ndarray] | None = None if name.base else (np.zeros(3), np.eye(3))
        self._n_asked = 0
        self._delay_s: list[float] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._arm, name)

    def motion_capture(self) -> Capture:
        """Return the newest frame.

        Raises:
            OSError: the frame is missed; the message says why.
        """
        self._n_asked += 1
        now_s = time.monotonic()
        try:
            seen = self._take()
        except OSError as error:
            if now_s - self._seen_s > LOST_S and not self._lost:
                self._lost = True
                self._tell(f"motion capture: lost: {error}")
            raise
        if self._lost:
            self._tell(f"motion capture: back after {now_s - self._seen_s:.1f} s")
        self._seen_s = now_s
        self._lost = False
        return seen

    def finish(self) -> str:
        """End the connection; return a line about the frames."""
        self._source.close()
        line = f"motion capture: the tip was seen in {len(self._delay_s)} of {self._n_asked} ticks"
        late = f"; at most {1e3 * max(self._delay_s):.0f} ms later than the fastest" if self._delay_s else ""
        return line + late

    def _newest(self) -> CaptureFrame | None:
        """Return the newest frame since the last call; None without one, or if it may be an old one."""
        frame = self._source.poll()
        now_s = time.monotonic()
        if frame is None:
            return None
        paused = now_s - self._polled_s > LOST_S
        self._polled_s = now_s
        if not paused:
            return frame
        # Frames have queued up, maybe until the queue was full: all may be old. The next one is new.
        for _ in range(MOST_POLLS):
            if self._source.poll() is None:
                break
        return None

    def _take(self) -> Capture:
        name = self._name
        frame = self._newest()
        if frame is None:
            raise TimeoutError(f"got no new frame from {name.host}")
        delay_s = self._delay.measure(frame.time_s, time.monotonic())
        if name.base:
            self._base = frame.bodies.get(name.base, self._base)
        if delay_s > LATE_S:
            raise TimeoutError(f"got a frame {1e3 * delay_s:.0f} ms late, expected {1e3 * LATE_S:g} at most")
        if self._base is None or name.body not in frame.bodies:
            hidden = name.base if self._base is None else name.body
            raise OSError(f"got a frame without the body {hidden!r}")

        # From the system's frame to the base's, then from its axes to ours
        (base_m, base_axes), (tip_m, tip_axes), up = self._base, frame.bodies[name.body], UP[name.up]
        turned = up @ base_axes.T
        self._delay_s.append(delay_s)
        return Capture(
            tip_m=turned @ (tip_m - base_m),
            tip_quaternion=quaternion_from_rotation(turned @ tip_axes @ up.T),
            marker_m=(frame.marker_m - base_m) @ turned.T,
        )


def with_capture(arm: Any, name: str | None, spec: ArmSpec, tell: Callable[[str], None]) -> Any:
    """Return an arm without pressure with motion capture by the name of `--capture`; None: the arm itself.

    Raises:
        InputError: the name is malformed, the system cannot be reached, has no such body, does not see it,
            or sees it far from the end of a straight arm.
    """
    if name is None:
        return arm
    read = CaptureName.read(name)
    where = f"--capture {name}"
    if hasattr(arm, "motion_capture"):
        raise InputError(f"{where}: got an arm with its own motion capture, expected one of the two")
    try:
        source = _KINDS[read.system](read)
    except OSError as error:
        raise InputError(f"{where}: {describe(error)}") from error
    captured = CapturedArm(arm, source, read, tell)
    try:
        _check_place(first_frame(captured, where), spec, where)
    except InputError:
        source.close()
        raise
    return captured


def _check_place(seen: Capture, spec: ArmSpec, where: str) -> None:
    """Refuse a tip that cannot be that of an arm without pressure: other axes, origin, unit or body."""
    expected_m, expected_axes = frame_from_pose(straight_pose(spec))
    off_m = np.linalg.norm(seen.tip_m - expected_m)
    turn = expected_axes.T @ rotation_from_quaternion(seen.tip_quaternion)
    turn_deg = np.degrees(np.linalg.norm(rotation_vector(turn)))
    if off_m > _NEAR * spec.length_m or turn_deg > _TURNED_DEG:
        got, expected = (
            ", ".join(f"{1e3 * x:.0f}" for x in position_m) for position_m in (seen.tip_m, expected_m)
        )
        raise InputError(
            f"{where}: got the tip at {got} mm, turned by {turn_deg:.0f} deg, expected it near {expected} "
            "mm, the end of the straight arm: is the origin the base, and is up=y or up=z right?"
        )
