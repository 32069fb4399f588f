"""Poses that an environment draws starts and goals from."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm.env.config import EnvConfig
from mjx_softarm.mechanics.kinematics import DOFS_PER_LINK
from mjx_softarm.mechanics.workspace import Pool, Seed, sample_evenly, sample_workspace
from mjx_softarm.spec import ArmSpec


class PosePool:
    """Poses of the workspace, a share of them uniform in volume; they are settled at the first use.

    A compiled function that takes them as an argument is compiled while they settle, and is the same program
    for all pools of one size.

    Args:
        spec: the arm.
        config: number of poses, share and seed.
        observed: function from poses and spring lengths to the poses that are observed.
    """

    def __init__(self, spec: ArmSpec, config: EnvConfig, observed: Callable[[Array, Array], Array]):
        self._spec, self._config, self._observed = spec, config, observed
        self._settled, self._given = (
            functools.cache(lambda: self.draw(config.workspace_seed)),
            ContextVar[Pool | None]("pool", default=None),
        )
        sizes = DOFS_PER_LINK * spec.n_links, spec.n_chambers, spec.n_springs, 6
        shapes: Any = (jax.ShapeDtypeStruct((config.n_poses, size), jnp.float32) for size in sizes)
        self.shapes = Pool(*shapes)  # in the places of arrays

    def __call__(self) -> Pool:
        """Return the poses."""
        if (given := self._given.get()) is not None:
            return given
        with ThreadPoolExecutor(1) as elsewhere:  # the first use may be in a function that is traced
            return elsewhere.submit(self._settled).result()

    @contextlib.contextmanager
    def given(self, pool: Pool) -> Iterator[None]:
        """Return other poses, such as an argument of a traced function, meanwhile and in this thread."""
        before = self._given.set(pool)
        try:
            yield
        finally:
            self._given.reset(before)

    def draw(self, seed: Seed) -> Pool:
        """Draw as many poses as the pool has, onto the device."""
        n_even = round(self._config.even_share * self._config.n_poses)
        counts = (self._config.n_poses - n_even, False), (n_even, True)
        parts = [self.sample(n, seed, evenly) for n, evenly in counts if n]
        return jax.device_put(jax.tree.map(lambda *part: np.concatenate(part), *parts))

    def sample(self, n: int, seed: Seed, evenly: bool = False) -> Pool:
        """Draw n poses with `sample_workspace` or `sample_evenly`, as they are observed, as NumPy arrays.

        NumPy, because JAX compiles a program for each operation outside of a compiled function.
        """
        pool = (sample_evenly if evenly else sample_workspace)(self._spec, n, seed)
        return pool._replace(pose=np.float32(self._observed(pool.pose, pool.spring_m)))
