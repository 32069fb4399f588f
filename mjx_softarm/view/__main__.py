"""Command line: `python -m mjx_softarm.view`.

Without a log, an arm is driven and steered from a page; Ctrl-C vents it and ends.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError, needing
from mjx_softarm.deploy.__main__ import Arm, DriverOptions, finish, tell
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.drivers.names import check_arm
from mjx_softarm.deploy.ending import save_log
from mjx_softarm.logs.files import check_file
from mjx_softarm.policy.file import SHIPPED, SHIPPED_TWIN, load_policy
from mjx_softarm.spec import ArmSpec

PROGRAM = "python -m mjx_softarm.view"
HINT = "try next: hang 500 g with the payload slider; the loop estimates it and corrects the circle"


@dataclass(frozen=True)
class Steered(DriverOptions):
    """Arm that the page steers, and its policy."""

    arm: Arm = "twin:0"
    policy: Annotated[
        cli.MaybePath,
        tyro.conf.arg(
            help="file that `python -m train export` wrote",
            help_behavior_hint="(default: the package's own, calibrated to twin:0, or for the paper's arm)",
        ),
    ] = None

    @property
    def file(self) -> Path:
        """File of the policy."""
        return self.policy or (SHIPPED_TWIN if re.fullmatch(r"twin:0(:\w+)*", self.arm) else SHIPPED)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    return cli.guarded(lambda: cli.parse(_view, PROGRAM, words)())


def _view(
    logs: tyro.conf.Positional[tuple[Path, ...]] = (),
    on: Annotated[Steered, tyro.conf.arg(name="")] = Steered(),
    log: cli.MaybePath = None,
    demos: cli.MaybePath = None,
    spec: cli.SpecFile = None,
    html: cli.MaybePath = None,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> int:
    """Show an arm in the browser and steer it there, or replay logs.

    Args:
        logs: logs of `deploy run` and `record`, CSV or npz, side by side
        log: file for the log of the steered run, CSV or npz
        demos: file for demonstrations, poses taken on the page for `train imitate`, CSV or npz
        html: file to write the logs to, as a page that plays without a server
        host: address to listen on; with another one everybody who reaches it can move the arm
        port: port to listen on; the next free one, if it is taken
    """
    # Check the options before anything is opened.
    with needing("view", "view"):
        import viser  # noqa: F401
    check_file("--log", log)
    check_file("--demos", demos)
    check_file("--html", html, (".html", ".htm"))
    if logs:
        return _replay(logs, ArmSpec.of(spec), html, host, port)
    if html is not None:
        raise InputError("--html: got no log, expected one or more, which are then written")
    # Drive an arm.
    from mjx_softarm.view.live import live
    from mjx_softarm.view.page import Setup

    read = load_policy(on.file)
    io = on.open(read.spec)
    check_arm(io, Controller.of(read), f"--arm {on.arm}")
    hint = HINT if on.file == SHIPPED_TWIN else ""
    setup = Setup(read, on.arm, host, port, hasattr(io, "attach"), demos is not None, hint)
    saves = [partial(save_log, path) if path else None for path in (log, demos)]
    status = live(setup, io, tell, *saves).status
    finish(io)
    return status


def _replay(logs: tuple[Path, ...], spec: ArmSpec, html: Path | None, host: str, port: int) -> int:
    from mjx_softarm.view.replay import Timeline, replay, share
    from mjx_softarm.view.stage import open_server

    timelines = [Timeline(path, spec) for path in logs]
    if html is not None:
        speed = share(html, spec, timelines)
        tell(f"wrote {html}, {html.stat().st_size / 1e6:.1f} MB" + f", {speed} times as fast" * (speed > 1))
        return 0
    server = open_server(host, port, ", ".join(timeline.name for timeline in timelines))
    tell(f"open http://{host}:{server.get_port()}; Ctrl-C ends")
    return replay(server, spec, timelines)


if __name__ == "__main__":
    sys.exit(main())
