"""Reachable poses of one workspace, compared with one another once for all controllers of the tests here."""

import pytest

from mjx_softarm.policy.reach import Reachable


@pytest.fixture(scope="session", autouse=True)
def poses_compared_once():
    made, from_poses = {}, Reachable.from_poses

    def once(pose, reward):
        key = id(pose), reward
        if key not in made:
            made[key] = from_poses(pose, reward), pose  # the pose is kept, so that its id stays its own
        return made[key][0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Reachable, "from_poses", once)
        yield
