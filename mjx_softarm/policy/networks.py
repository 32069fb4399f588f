"""Networks and poses of an arm that its computer needs, whichever policy drives the arm."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_softarm._support.archive import Entries
from mjx_softarm.sensing.estimator import PoseEstimator, SpringModel, take_estimator, take_spring_model
from mjx_softarm.sensing.load import LoadEstimator, take_load_estimator
from mjx_softarm.sensing.s2r import S2R
from mjx_softarm.spec import ArmSpec


class ArmModel(NamedTuple):
    """Networks and poses of an arm that its computer needs besides the specification."""

    workspace: np.ndarray  # (m, 6) poses [mm, deg]
    estimator: PoseEstimator
    load_estimator: LoadEstimator
    spring_model: SpringModel
    s2r: S2R | None


def take_networks(entries: Entries, spec: ArmSpec) -> tuple[PoseEstimator, LoadEstimator, SpringModel]:
    """Take the networks `estimator`, `load_estimator` and `spring_model` of an arm from a file's entries."""
    n_sections, counts = spec.structure.n_sections, (spec.n_chambers, spec.n_springs)
    return (
        take_estimator(entries, "estimator", n_sections, spec.n_springs),
        take_load_estimator(entries, "load_estimator", n_sections, *counts),
        take_spring_model(entries, "spring_model", *counts),
    )
