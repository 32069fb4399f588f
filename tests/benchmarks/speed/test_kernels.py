"""Kernels, bytes and exchanges of programs, read from HLO written by hand and by XLA."""

import jax
import jax.numpy as jnp
import pytest

from benchmarks.speed.kernels import Loop, read

PROGRAM = """HloModule jit_f, is_scheduled=true

%fused (p: f32[8,4]) -> f32[8,4] {
  %p = f32[8,4]{1,0} parameter(0)
  ROOT %twice = f32[8,4]{1,0} add(%p, %p)
}

%fixed.body (a: (s32[], f32[8,4])) -> (s32[], f32[8,4]) {
  %a = (s32[], f32[8,4]{1,0}) parameter(0)
  %x = f32[8,4]{1,0} get-tuple-element(%a), index=1
  %i = s32[] get-tuple-element(%a), index=0
  %y = f32[8,4]{1,0} fusion(%x), kind=kLoop, calls=%fused
  ROOT %t = (s32[], f32[8,4]{1,0}) tuple(%i, %y)
}

%fixed.condition (b: (s32[], f32[8,4])) -> pred[] {
  %b = (s32[], f32[8,4]{1,0}) parameter(0)
  ROOT %c = pred[] fusion(%b), kind=kLoop, calls=%fused
}

%open.body (d: (s32[], f32[8,4])) -> (s32[], f32[8,4]) {
  %d = (s32[], f32[8,4]{1,0}) parameter(0)
  ROOT %w = (s32[], f32[8,4]{1,0}) while(%d), condition=%fixed.condition, body=%fixed.body, \
backend_config={"known_trip_count":{"n":"12"}}
}

%open.condition (e: (s32[], f32[8,4])) -> pred[] {
  %e = (s32[], f32[8,4]{1,0}) parameter(0)
  %i.2 = s32[] get-tuple-element(%e), index=0
  ROOT %less = pred[] compare(%i.2, %i.2), direction=LT
}

%called (k: bf16[8]) -> (bf16[8], s8[64]) {
  %k = bf16[8]{0} parameter(0)
  ROOT %library = (bf16[8]{0}, s8[64]{0}) custom-call(%k, %k), custom_call_target="product"
}

%one (g: bf16[8]) -> bf16[8] {
  %g = bf16[8]{0} parameter(0)
  %graph = (bf16[8]{0}, s8[64]{0}) call(%g), to_apply=%called
  %first = bf16[8]{0} get-tuple-element(%graph), index=0
  ROOT %copied = bf16[8]{0:T(8,128)} copy(%first)
}

%other (h: bf16[8]) -> bf16[8] {
  ROOT %h = bf16[8]{0} parameter(0)
}

ENTRY %main (m: (s32[], f32[8,4]), n: bf16[8], o: pred[]) -> bf16[8] {
  %m = (s32[], /*index=1*/f32[8,4]{1,0}) parameter(0)
  %n = bf16[8]{0} parameter(1)
  %o = pred[] parameter(2)
  %v = (s32[], f32[8,4]{1,0}) while(%m), condition=%open.condition, body=%open.body
  %started = (bf16[8]{0}, bf16[8]{0}) copy-start(%n)
  %done = bf16[8]{0} copy-done(%started)
  ROOT %r = bf16[8]{0} conditional(%o, %n, %n), true_computation=%other, false_computation=%one
}
"""
FIXED = Loop(12, kernels=(2 * 4 * 32,), exchanges=(), inside=())
OPEN = Loop(None, kernels=(1 + 2 * 4,), exchanges=(), inside=(FIXED,))
ROW = 2 * 8  # bytes of bf16[8]


def test_loops_have_their_kernels_and_bytes():
    copied_async, library, copied = 3 * ROW, 3 * ROW, 2 * ROW  # a library's scratch memory does not count
    assert read(PROGRAM) == Loop(1, kernels=(copied_async, library, copied), exchanges=(), inside=(OPEN,))


def test_totals_are_those_of_all_turns():
    assert OPEN.over_turns(5).tolist() == [5 * (1 + 12), 5 * (9 + 12 * 256)]
    assert read(PROGRAM).over_turns(2).tolist() == [3 + 2 * 13, 8 * ROW + 2 * (9 + 12 * 256)]


def test_hlo_as_xla_writes_it_is_read():
    def until(x):
        return jax.lax.while_loop(lambda x: jnp.sum(x) < 1e3, lambda x: jnp.sin(x) + 2.0, x)

    def function(x):
        return until(jax.lax.fori_loop(0, 7, lambda _, x: jnp.cos(x) * 3.0, x))

    program = read(jax.jit(function).lower(jnp.ones((16, 16))).compile().as_text())
    assert [loop.n_turns for loop in program.inside] == [7, None]
    assert all(sum(loop.kernels) >= 2 * 4 * 16 * 16 for loop in program.inside)


EXCHANGED = """HloModule jit_g, is_scheduled=true

ENTRY %main (p: f32[8], q: pred[32]) -> f32[8] {
  %p = f32[8]{0} parameter(0)
  %q = pred[32]{0} parameter(1)
  %summed = f32[8]{0} all-reduce-start(%p), channel_id=1, to_apply=%add
  %sum = f32[8]{0} all-reduce-done(%summed)
  %gathered = ((f32[8]{0}, f32[8]{0}), (f32[64]{0}, f32[64]{0})) all-gather-start(%p, %sum), channel_id=2
  %all = (f32[64]{0}, f32[64]{0}) all-gather-done(%gathered)
  %scattered = ((pred[32]{0}), pred[4]{0}) reduce-scatter-start(%q), channel_id=3
  %part = pred[4]{0} reduce-scatter-done(%scattered)
  ROOT %moved = f32[8]{0} collective-permute(%sum), channel_id=4
}
"""


def test_exchanges_have_the_bytes_of_their_larger_side():
    expected = (("all-reduce", 32), ("all-gather", 512), ("reduce-scatter", 32), ("collective-permute", 32))
    assert read(EXCHANGED).exchanges == expected


def test_exchanges_as_xla_writes_them_are_read():
    if len(jax.devices()) < 8:
        pytest.skip("needs 8 devices, which a CPU can simulate")
    mesh = jax.make_mesh((8,), ("devices",))
    rows = jax.device_put(jnp.ones((16, 4)), jax.NamedSharding(mesh, jax.P("devices")))
    program = jax.jit(lambda x: jnp.cos(x).sum(axis=0)).lower(rows).compile().as_text()
    assert read(program).exchanges == (("all-reduce", 16),)


def test_each_loop_that_has_kernels_has_a_row_with_its_turns_and_those_around_it():
    exchanges = (("all-reduce", 936_000), ("all-gather", 12))
    rows = list(Loop(1, (48_000_000, 0), exchanges, (Loop(4, (), (), (OPEN,)),)).rows())
    assert [row["turns"] for row in rows] == ["once", "4 x until settled", "4 x until settled x 12"]
    assert rows[0] == {
        "turns": "once",
        "kernels": 2,
        "mb": 48.0,
        "exchanges": "all-reduce 0.936 MB, all-gather 1.2e-05 MB",
    }
