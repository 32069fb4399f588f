"""Options of the compiler: those that the installed jaxlib accepts, wherever they are asked for."""

import jax
import jax.numpy as jnp
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


def test_a_helper_is_traced_once_in_a_program_and_in_its_gradients():
    """A rule of a derivative, a loop and a plain call share the trace; by `jax.jit` alone they do not."""
    traces = []

    @jax.jit
    def helper(x):
        traces.append(x)
        return jnp.sin(x)

    @jax.custom_jvp
    def ruled(x):
        return helper(x)

    @ruled.defjvp
    def rule(primals, tangents):
        (x,), (dx,) = primals, tangents
        return helper(x), helper(x) * dx

    def program(x):
        _, many = jax.lax.scan(lambda carry, _: (helper(carry), carry), x, None, length=3)
        return helper(x) + jax.grad(ruled)(x) + jnp.sum(many)

    found = xla.jit(program)(jnp.float32(0.5))
    assert len(traces) == 1
    traces.clear()
    assert jax.jit(lambda x: program(x))(jnp.float32(0.5)) == pytest.approx(float(found))
