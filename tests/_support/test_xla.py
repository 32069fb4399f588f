"""Options of the compiler: those that the installed jaxlib accepts, wherever they are asked for."""

import jax
import pytest

from mjx_softarm._support import xla

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="options are set on CPUs alone")


options = xla.compiler_options.__wrapped__  # without its cache


def test_unknown_options_are_left_out(monkeypatch):
    monkeypatch.setattr(xla, "_CPU_OPTIONS", {"xla_no_such_option": True})
    assert options("networks") == {}


def test_options_can_be_asked_for_while_a_function_is_traced():
    inside = []
    jax.jit(lambda x: inside.append(options()))(0.0)
    assert inside == [options()]
