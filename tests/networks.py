"""Sim-to-real networks of tests."""

import numpy as np

from mjx_softarm.sensing.s2r import S2R


def s2r_of(layers, bound, **others):
    """A network whose inputs lie between -1 and 1, and its corrections within a bound; its anchor is zero."""
    edge = np.ones(len(layers[0][0]), np.float32)
    most = np.broadcast_to(np.float32(bound), np.shape(layers[-1][1]))
    known = {"input_low": -edge, "input_high": edge, "output_low": -most, "output_high": most}
    known |= {"anchors": 0.0 * edge[None], "limit": np.float32(1.0)}
    return S2R(layers, **(known | others))
