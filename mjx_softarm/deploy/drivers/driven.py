"""Options of the commands that drive an arm: `--arm` and `--capture`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from mjx_softarm.deploy.capture import CapturedArm, with_capture
from mjx_softarm.deploy.drivers.names import open_arm
from mjx_softarm.spec import ArmSpec

Arm = Annotated[
    str,
    tyro.conf.arg(
        help="yours: package.module:Class, or a file of hardware, wiring.toml; simulated: twin:SEED, or "
        "twin:rod:SEED; twin:SEED@ARM.toml, of another arm; twin:SEED:pipe300, in a pipe; "
        "twin:SEED:aged, later; twin:SEED:exact, as specified; twin:SEED:500g, with a payload"
    ),
]


@dataclass(frozen=True)
class Driven:
    """Arm that a command drives, and motion capture beside its driver."""

    arm: Arm
    capture: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="SYSTEM:HOST:BODY",
            help="natnet:HOST:BODY or qualisys:HOST:BODY, for an arm whose driver has no motion capture; "
            "options: ,base=BODY,markers=NAME,up=y|z",
        ),
    ] = None

    def open(self, spec: ArmSpec, tell: Callable[[str], None]) -> Any:
        """Open the driver of an arm with this specification, and its motion capture, which tells its gaps.

        Raises:
            InputError: one of them cannot be had.
        """
        return with_capture(open_arm(self.arm), self.capture, spec, tell)


Arms = Annotated[Driven, tyro.conf.arg(name="")]


def finish(driver: Any, tell: Callable[[str], None]) -> None:
    """End the motion capture that `--capture` began, and tell a line about its frames."""
    if isinstance(driver, CapturedArm):
        tell(driver.finish())
