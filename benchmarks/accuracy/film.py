"""Film of arms in motion: policies side by side, from far goal to far goal."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from PIL import Image

from benchmarks.accuracy.learning import open_runs
from benchmarks.paper.film import HEIGHT, WIDTH, SideView, frames, write_gif
from mjx_softarm._support import xla
from mjx_softarm._support.errors import InputError
from mjx_softarm.env import ReachEnv
from mjx_softarm.mechanics.drawing.render import Renderer
from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.mechanics.workspace import HELD_OUT_SEED
from train.runs.evaluate import nominal, towards
from train.runs.folder import Run
from train.runs.run import task_of_run

ACTION_S, FRAME_S = 0.5, 0.1  # simulated time between two actions, and between two pictures
N_GOALS, SECONDS = 5, 2.5  # goals, and simulated time for each
FAR_MM = 150.0  # least distance between one goal and the next


def film(runs: tuple[Path, ...], out: Path = Path("docs/results/motion.gif")) -> int:
    """Draw the arms of finished runs in motion, side by side on the way to the same far goals.

    Args:
        runs: folders of finished runs
        out: file to write

    Raises:
        InputError: there are no folders.
        RunError: a folder holds no finished run.
    """
    opened = open_runs(runs)
    goals = far_goals(_env(opened[0]).sample_pool(200, HELD_OUT_SEED).pose)
    sides = [_frames(run, goals) for run in opened]
    write_gif(out, [Image.fromarray(np.concatenate(both, axis=1)) for both in zip(*sides, strict=True)])
    print(f"film: {out}")
    return 0


def _env(run: Run) -> ReachEnv:
    """Return a run's arm in motion, which is seen more often than it is told what to do."""
    config = dataclasses.replace(run.config.env, mode="dynamic", dynamic_step_s=FRAME_S)
    return nominal(ReachEnv(run.spec, config, run.arm.s2r))


def _frames(run: Run, goals: Array) -> list[np.ndarray]:
    """Return pictures of a run's arm on its way to goals (n, 6), each beside the way of its tip so far."""
    env, learner, policy = _env(run), task_of_run(run).job.learner, run.policy()
    act = xla.jit(lambda obs: learner.mode(policy, obs))
    step, pictures, tips, off_mm = xla.jit(env.step), [], [], []

    # From goal to goal.
    state = env.reset(jax.random.PRNGKey(HELD_OUT_SEED))
    with Renderer(build_model(env.spec), WIDTH, HEIGHT) as renderer:
        for goal in goals:
            state = towards(env, state, goal)
            for k in range(round(SECONDS / FRAME_S)):
                if k % round(ACTION_S / FRAME_S) == 0:
                    action = act(state.obs)
                state = step(state, action)
                arm = state.pipeline_state
                pictures.append(renderer.draw(np.asarray(arm.motion.q)))
                tips.append(np.asarray(arm.pose[:3]))
            off_mm.append(float(state.metrics["tip_error_mm"]))
    trained = "in motion" if run.config.env.moves else "at rest"
    told = f"{np.mean(off_mm):.1f} mm off after {SECONDS:g} s"
    side = SideView(f"trained {trained}", told, [0, 2], np.asarray(goals[:, :3]))
    return [np.asarray(image) for image in frames(pictures, np.array(tips), side)]


def far_goals(poses: Array) -> Array:
    """Return `N_GOALS` of the poses (n, 6) [mm, deg] in their order, each far from the one before.

    Raises:
        InputError: the poses are too close to each other.
    """
    chosen = [0]
    for row, pose in enumerate(poses):
        if len(chosen) < N_GOALS and jnp.linalg.norm(pose[:3] - poses[chosen[-1], :3]) > FAR_MM:
            chosen.append(row)
    if len(chosen) < N_GOALS:
        raise InputError(f"poses: got {len(chosen)} that are {FAR_MM:g} mm apart, expected {N_GOALS}")
    return poses[jnp.array(chosen)]
