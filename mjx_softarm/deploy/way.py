"""A goal that moves past poses, from one stop to the next."""

from __future__ import annotations

import numpy as np

from mjx_softarm.sensing.pose import pose_error


class Way:
    """Poses on straight lines, all as far apart in time, some of which are stops."""

    def __init__(self, goals: np.ndarray, stops: np.ndarray, pace_s: float, lead_s: float):
        """Take a way.

        Args:
            goals (p, 6) [mm, deg]: poses, two or more.
            stops (p,): bool; the first and the last are stops in any case.
            pace_s: time from a pose to the next.
            lead_s: by so much the goal that a controller is given is ahead.
        """
        self.goals, self.pace_s, self.lead_s = np.asarray(goals, float), pace_s, lead_s
        self.stops = np.union1d(np.flatnonzero(stops), [0, len(goals) - 1])
        self.began_s, self._leg = 0.0, self.goals
        self.rows: list[slice] = []  # of the log, while the goal moves

    def begin(self, k: int, now_s: float, row: int) -> int:
        """Let the goal leave the k-th pose, at a row of the log; return the index of the next stop."""
        stop = int(self.stops[self.stops > k][0])
        self.began_s, self._leg = now_s, self.goals[k : stop + 1]
        self.rows.append(slice(row, row))
        return stop

    def go_on(self, now_s: float, row: int) -> bool:
        """Return whether the goal still moves, at a row of the log."""
        self.rows[-1] = slice(self.rows[-1].start, row)
        return now_s - self.began_s < self.pace_s * (len(self._leg) - 1)

    def goal(self, now_s: float) -> np.ndarray:
        """Return where the goal is (6,) [mm, deg]."""
        return on_the_way(self._leg, (now_s - self.began_s) / (self.pace_s * (len(self._leg) - 1)))

    def goal_ahead(self, now_s: float) -> np.ndarray:
        """Return the goal (6,) [mm, deg] that a controller is given."""
        return self.goal(now_s + self.lead_s)


def on_the_way(goals: np.ndarray, share: float) -> np.ndarray:
    """Return the pose (6,) [mm, deg] after a share of the way past goals (p, 6); its end for more than 1."""
    at = min(share, 1.0) * (len(goals) - 1)
    k = min(int(at), len(goals) - 2)
    return goals[k] + (at - k) * pose_error(goals[k + 1], goals[k])
