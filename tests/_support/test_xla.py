"""Options of the compiler: those that the installed jaxlib accepts, wherever they are asked for."""

import jax
import numpy as np
import pytest

from mjx_softarm._support import xla

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="options are set on CPUs alone")


def test_unknown_options_are_left_out(monkeypatch):
    monkeypatch.setattr(xla, "_CPU_OPTIONS", {"xla_no_such_option": True})
    xla.compiler_options.cache_clear()
    try:
        assert xla.compiler_options("networks") == {}
    finally:
        xla.compiler_options.cache_clear()


def test_options_can_be_asked_for_while_a_function_is_traced():
    outside = xla.compiler_options()
    inside = []

    def traced(x):
        xla.compiler_options.cache_clear()
        inside.append(xla.compiler_options())
        return 2 * x

    assert jax.jit(traced)(np.float32(3.0)) == 6.0
    assert inside == [outside]
