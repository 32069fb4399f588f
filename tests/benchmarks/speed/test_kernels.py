"""Kernels and bytes of programs, read from HLO written by hand and by XLA; what fails is told."""

import jax
import jax.numpy as jnp
import pytest

from benchmarks.harness.peers import PeerError
from benchmarks.harness.rounds import WorkerError
from benchmarks.speed import kernels
from benchmarks.speed.hlo import Loop, read

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
FIXED = Loop(turns=12, kernels=(2 * 4 * 32,), inside=())
OPEN = Loop(turns=None, kernels=(1 + 2 * 4,), inside=(FIXED,))
ROW = 2 * 8  # bytes of bf16[8]


@pytest.mark.parametrize(
    "conditional",
    ["true_computation=%other, false_computation=%one", "branch_computations={%other, %other, %one}"],
)
def test_loops_of_a_program_with_their_kernels_and_bytes(conditional):
    text = PROGRAM.replace("true_computation=%other, false_computation=%one", conditional)
    begun, library, copied = 3 * ROW, 3 * ROW, 2 * ROW  # a library's scratch is not moved
    assert read(text) == Loop(1, kernels=(begun, library, copied), inside=(OPEN,))


def test_launches_and_costs_are_those_of_all_turns():
    assert FIXED.launches(5) == 12
    assert OPEN.launches(5) == 5 * (1 + 12)
    assert read(PROGRAM).launches(5) == 3 + 5 * 13
    assert read(PROGRAM).total(float, 2) == 8 * ROW + 2 * (9 + 12 * 256)


def test_what_xla_writes_is_read():
    def until(x):
        return jax.lax.while_loop(lambda x: jnp.sum(x) < 1e3, lambda x: jnp.sin(x) + 2.0, x)

    def function(x):
        return until(jax.lax.fori_loop(0, 7, lambda _, x: jnp.cos(x) * 3.0, x))

    program = read(jax.jit(function).lower(jnp.ones((16, 16))).compile().as_text())
    turns = [loop.turns for loop in program.inside]
    assert turns == [7, None]
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


def test_exchanges_that_xla_writes_are_read():
    if len(jax.devices()) < 8:
        pytest.skip("needs 8 devices, which a CPU can simulate")
    mesh = jax.make_mesh((8,), ("devices",))
    rows = jax.device_put(jnp.ones((16, 4)), jax.NamedSharding(mesh, jax.P("devices")))
    program = jax.jit(lambda x: jnp.cos(x).sum(axis=0)).lower(rows).compile().as_text()
    assert read(program).exchanges == (("all-reduce", 16),)


@pytest.mark.parametrize("text", ["", "HloModule nothing\n"])
def test_what_is_no_program_is_refused(text):
    with pytest.raises(ValueError, match="expected an ENTRY computation"):
        read(text)


@pytest.mark.parametrize("lost", ["%fixed.body (", "%one (", "  %x = "])
def test_what_is_named_and_not_there_is_told(lost):
    with pytest.raises(ValueError, match="expected a computation or an instruction called"):
        read(PROGRAM.replace(lost, lost.replace("%", "%no.")))


LARGE = 48_000_000  # bytes that take 10 us


def test_each_loop_that_has_kernels_has_a_row_with_its_turns_and_those_around_it():
    rows = list(kernels.rows(Loop(1, (LARGE, 0), (Loop(4, (), (OPEN,)),))))
    assert [row["turns"] for row in rows] == ["once", "4 x until at rest", "4 x until at rest x 12"]
    assert rows[0] == {"turns": "once", "kernels": 2, "mb": 48.0, "launch_bound": 0.5, "calculated_us": 13.0}


def test_a_step_of_all_arms_takes_its_kernels_launches_or_its_bytes():
    step = kernels.in_all(Loop(1, (LARGE,), (OPEN._replace(inside=()),)), turns=10)
    assert step["kernels"] == 11 and step["gb"] == 0.05
    assert step["calculated_ms"] == 0.04  # 10 us, and ten times 3
    assert step["calculated_env_steps_per_s"] == pytest.approx(kernels.N_ARMS / 40e-6, rel=0.03)


class Told:
    """In place of a worker: one program fails, the others tell a loop as it comes through JSON."""

    made: list  # of where, program and interpreter

    def __init__(self, name, program, python=None):
        self.name, self.facts = name, {}
        self.made.append((program[1], program[2], python))

    def start(self):
        if "mjx" in self.name:
            raise WorkerError(f"{self.name}: stopped with status 1, expected a result:\nno memory")
        self.facts = {"compiling_s": 1.0, "loops": [1, [5, 5], [[None, [5, 5, 5], [], []]], []]}
        if "8 GPUs" in self.name:
            self.facts["loops"] = [1, [], [[4, [9e6], [], [["all-reduce", 5e6]]]], []]

    def close(self):
        pass


@pytest.fixture
def told(monkeypatch):
    """Workers that compile nothing, on a machine without a GPU: a list of what they were asked for."""
    monkeypatch.setattr(Told, "made", [], raising=False)
    monkeypatch.setattr(kernels, "Worker", Told)
    monkeypatch.setattr(kernels, "peer_python", lambda name: name)
    monkeypatch.setattr(kernels, "newton_steps", lambda: 2)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    return Told.made


def test_programs_are_compiled_for_a_gpu_that_is_not_there_and_one_that_fails_costs_no_other(told):
    figures = kernels.measure()
    wheres = {name: "h200x8" if "8 GPUs" in name else "h200" for name in kernels.PROGRAMS}
    assert told == [(wheres[name], program[0], "gpu-compiler") for name, program in kernels.PROGRAMS.items()]
    chain, mjx, epoch, _ = figures["programs"]
    assert chain["kernels"] == 2 + 2 * 3 and "kernels" not in epoch
    assert mjx["failed"].startswith("env step, mjx") and mjx["failed"].endswith("no memory")
    assert [row["kernels"] for row in figures["loops"]] == [2, 3, 2, 3, 1]
    of_eight = {"program": "training epoch on 8 GPUs", "turns": "4", "exchange": "all-reduce", "mb": 5.0}
    assert figures["exchanges"] == [of_eight]


def test_a_gpu_that_is_there_needs_no_other_environment(told, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    kernels.measure()
    assert {(where, python) for where, _, python in told} == {("here", None), ("h200x8", None)}


def test_without_gpu_and_compiler_it_says_so(told, monkeypatch):
    def no_environment(name):
        raise PeerError(f"{name}: no matching distribution")

    monkeypatch.setattr(kernels, "peer_python", no_environment)
    why = kernels.measure()["skipped"]
    assert "no CUDA device" in why and "no matching distribution" in why and not told


@pytest.mark.slow
def test_a_step_of_arms_is_compiled_for_an_h200():
    program = ["benchmarks.speed.kernels_worker", "h200", "env-step", "chain", "64"]
    worker = kernels.Worker("step", program, kernels.peer_python(kernels.COMPILER))
    try:
        worker.start()
    finally:
        worker.close()
    step = kernels.told_loop(worker.facts["loops"])
    (newton,) = step.inside
    assert newton.turns is None and newton.inside == ()  # eliminations have no loops
    assert 50 < len(newton.kernels) < 200
