"""A goal that moves past poses in a given time."""

from __future__ import annotations

import numpy as np

from mjx_softarm.sensing.pose import pose_error


class Way:
    """Poses that a goal passes at equal times, on straight lines in between."""

    def __init__(self, goals: np.ndarray, seconds: float, lead_s: float):
        """Take a way.

        Args:
            goals (p, 6) [mm, deg]: poses, two or more.
            seconds: time from the first to the last.
            lead_s: by so much the goal that a controller is given is ahead.
        """
        self.goals, self.seconds, self.lead_s = np.asarray(goals, float), seconds, lead_s
        self.began_s: float | None = None
        self.rows = slice(0)  # of the log, while the goal moves

    def begin(self, now_s: float, row: int) -> None:
        """Let the goal leave its first pose; the log has so many rows."""
        self.began_s, self.rows = now_s, slice(row, row)

    def go_on(self, now_s: float, row: int) -> bool:
        """Return whether the goal still moves; the log has so many rows."""
        self.rows = slice(self.rows.start, row)
        return self.began_s is not None and now_s - self.began_s < self.seconds

    def goal(self, now_s: float) -> np.ndarray:
        """Return where the goal is (6,) [mm, deg]."""
        assert self.began_s is not None
        return on_the_way(self.goals, (now_s - self.began_s) / self.seconds)

    def goal_ahead(self, now_s: float) -> np.ndarray:
        """Return the goal (6,) [mm, deg] that a controller is given."""
        return self.goal(now_s + self.lead_s)


def on_the_way(goals: np.ndarray, share: float) -> np.ndarray:
    """Return the pose (6,) [mm, deg] after a share of the way past goals (p, 6); its end for more than 1."""
    at = min(share, 1.0) * (len(goals) - 1)
    k = min(int(at), len(goals) - 2)
    return goals[k] + (at - k) * pose_error(goals[k + 1], goals[k])
