"""Worker of the kernels benchmark: a program of this project compiled for a GPU, and what that GPU is to do.

    python -m benchmarks.speed.kernels_worker WHERE PROGRAM [SETTING ...]

WHERE is `here`, this machine's GPU, or `h200` or `h200x8`, one or eight, for which a program is compiled
without them: that needs the package jax-cuda12-plugin, but neither CUDA nor a driver. What XLA would choose
by trying on the device, it then chooses by rule. PROGRAM is `env-step` with an engine and a number of arms,
or `epoch` with settings of the preset quick, spread over all of the GPUs.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from typing import Any

H200 = """
gpu_device_info {
  threads_per_block_limit: 1024  threads_per_warp: 32  threads_per_core_limit: 2048
  shared_memory_per_block: 49152  shared_memory_per_core: 233472  shared_memory_per_block_optin: 232448
  core_count: 132  fpus_per_core: 128  clock_rate_ghz: 1.98
  block_dim_limit_x: 2147483647  block_dim_limit_y: 65535  block_dim_limit_z: 65535
  registers_per_core_limit: 65536  registers_per_block_limit: 65536
  memory_bandwidth: 4800000000000  l2_cache_size: 52428800  device_memory_size: 151397597184
  cuda_compute_capability { major: 9 }
}
platform_name: "CUDA"
dnn_version_info { major: 9  minor: 10 }
runtime_version { major: 12  minor: 9 }
device_description_str: "NVIDIA H200"
"""  # figures of XLA's own description, xla/backends/gpu/target_config/specs/h200.txtpb


def env_step(mesh: Any, engine: str, n_arms: str) -> tuple[Callable, tuple[Any, ...]]:
    """One action of all arms, settling and resets included, and the shapes of what it is called with."""
    import jax
    import jax.numpy as jnp

    from mjx_softarm.env import EnvConfig, ReachEnv
    from mjx_softarm.env.gym import EPISODE_LENGTH
    from mjx_softarm.env.vector import VectorEnv
    from train.epoch.devices import everywhere

    env = ReachEnv(config=EnvConfig(engine=engine, n_poses=1024))  # type: ignore[arg-type]
    arms, key = VectorEnv(env, int(n_arms), EPISODE_LENGTH), jax.random.PRNGKey(0)
    arguments = jax.eval_shape(arms.reset, key), jnp.zeros((arms.n, env.action_size)), key
    return jax.jit(arms.step), placed(arguments, everywhere(mesh))


def epoch(mesh: Any, *settings: str) -> tuple[Callable, tuple[Any, ...]]:
    """An epoch of training, and the shapes of what it is called with."""
    import jax

    from mjx_softarm.env import ReachEnv
    from train.config import PRESETS, override
    from train.epoch.devices import everywhere
    from train.epoch.job import Job

    config = override(PRESETS["quick"], list(settings))
    job = Job(config, ReachEnv(config=config.env), mesh if mesh.size > 1 else None)
    state = jax.eval_shape(job.init, jax.random.PRNGKey(0))
    return job.epoch, (placed(state, job.sharding or everywhere(mesh)),)


PROGRAMS: dict[str, Callable[..., tuple[Callable, tuple[Any, ...]]]] = {"env-step": env_step, "epoch": epoch}


def placed(tree: Any, shardings: Any) -> Any:
    """Shapes of a tree of arrays that lie as another tree says, which may be a prefix of it."""
    import jax

    each = jax.tree.broadcast(shardings, tree)
    return jax.tree.map(lambda x, where: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=where), tree, each)


def devices(where: str) -> tuple[str, Any]:
    """The GPUs' name, and the mesh that they form; call it before JAX is used."""
    if where != "here":
        os.environ["JAX_SKIP_CUDA_CONSTRAINTS_CHECK"] = "1"  # of a driver that is not there
        os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_gpu_autotune_level=0"
    import jax
    import numpy as np
    from jax.experimental import topologies
    from jax.sharding import Mesh

    from train.epoch.devices import AXIS

    if where == "here":
        gpu = jax.devices("gpu")[0]
        return gpu.device_kind, Mesh(np.array([gpu]), (AXIS,))
    n = int(where.removeprefix("h200").removeprefix("x") or 1)
    topology = topologies.get_topology_desc(platform="cuda", target_config=H200, topology=f"1x{n}x1")
    several = f"{n} x " if n > 1 else ""
    return f"{several}NVIDIA H200, not there", topologies.make_mesh(topology, (n,), (AXIS,))


def compiled(where: str, program: str, *settings: str) -> dict[str, Any]:
    """For which GPUs, seconds to trace and to compile, memory, and the loops of a program."""
    name, mesh = devices(where)
    from benchmarks.speed import hlo

    function, shapes = PROGRAMS[program](mesh, *settings)
    start = time.perf_counter()
    lowered = function.lower(*shapes)
    traced = time.perf_counter()
    made = lowered.compile()
    done = time.perf_counter()
    memory = made.memory_analysis()
    own = memory.output_size_in_bytes - memory.alias_size_in_bytes  # results that lie in no argument
    needed = memory.argument_size_in_bytes + own + memory.temp_size_in_bytes
    return {
        "device": name,
        "tracing_s": round(traced - start, 1),
        "compiling_s": round(done - traced, 1),
        "memory_mb": round(1e-6 * needed, 1),  # of each device
        "loops": hlo.read(made.as_text()),
    }


if __name__ == "__main__":
    from benchmarks.harness.rounds import serve

    serve(lambda: (compiled(*sys.argv[1:]), dict))
