"""Command line: `python -m mjx_softarm.view`.

Without a log, an arm is driven and steered from a page; Ctrl-C vents it and ends.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial

from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.__main__ import Arm
from mjx_softarm.deploy.arms import open_arm
from mjx_softarm.deploy.ending import save_log
from mjx_softarm.policy.file import load_policy

PROGRAM, HERE = "python -m mjx_softarm.view", "127.0.0.1"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    return cli.guarded(lambda: cli.parse(_view, PROGRAM, words)())


def _view(
    policy: cli.MaybePath = None,
    arm: Arm = "twin:7",
    log: cli.MaybePath = None,
    host: str = HERE,
    port: int = 8080,
) -> int:
    """Show an arm in the browser and steer it there.

    Args:
        policy: file that `python -m train export` wrote
        log: file for the run's log, CSV or npz
        host: address to listen on; another one lets everybody who reaches it move the arm
        port: port to listen on; the next free one, if it is taken
    """
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise InputError(f"the view needs viser (pip install 'mjx-softarm[view]'): {error}") from error
    from mjx_softarm.view.live import Setup, live

    if policy is None:
        made = "`make demo` trains one in two minutes and writes runs/quick/policy.npz"
        raise InputError(f"--policy: got nothing, expected a policy; {made}")
    io, save = open_arm(arm), partial(save_log, log) if log else None
    setup = Setup(load_policy(policy), arm, host, port, hasattr(io, "attach"))
    return live(setup, io, _tell, partial(_welcome, host), save).status


def _welcome(host: str, url: str) -> None:
    _tell(f"open {url}; Ctrl-C vents the arm and ends")
    if host not in (HERE, "localhost"):
        _tell(f"--host {host}: everybody who reaches this address can move the arm; there is no password")


def _tell(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
