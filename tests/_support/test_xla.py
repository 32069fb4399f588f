"""Options of the compiler: those that the installed jaxlib accepts, wherever they are asked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm._support import xla

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="options are set on CPUs alone")


@pytest.mark.skipif(
    not jax.lib.__version__.startswith("0.10."), reason="it is of this version that it is known"
)
def test_the_library_of_jaxlib_0_10_is_off():
    assert xla.compiler_options("networks")["xla_cpu_experimental_ynn_fusion_type"] == ""


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


def test_a_function_of_a_module_is_compiled_with_the_options_at_its_first_call(monkeypatch):
    asked = []
    monkeypatch.setattr(xla, "compiler_options", lambda kind: asked.append(kind) or {})

    @xla.jit_at_first_call(kind="networks", static_argnames="n")
    def power(x, n):
        return x ** len(range(n))  # which a traced n has not

    assert asked == []
    assert power(np.float32(3.0), n=2) == 9.0 and power(np.float32(2.0), n=3) == 8.0
    assert asked == ["networks"]


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
