"""Servers of motion capture on ports of their own, and arms that they see."""

import numpy as np
import pytest

from mjx_softarm.deploy.capture import with_capture
from tests.deploy.capture.scene import SPEC
from tests.deploy.capture.servers import NatNetServer, QualisysServer


class Arm:
    extra = "the driver's own"

    def read_sensors(self):
        return np.ones(9)


@pytest.fixture
def serve(monkeypatch, request):
    """Return what starts a server of a system, on a port of its own."""

    def make(system, scene, **options):
        package, kind, port = {
            "natnet": ("natnet", NatNetServer, "natnet.COMMAND_PORT"),
            "qualisys": ("qtm_rt", QualisysServer, "qualisys.PORT"),
        }[system]
        pytest.importorskip(package, reason="pip install -e '.[capture]'")
        server = kind(scene, **options)
        monkeypatch.setattr(f"mjx_softarm.deploy.capture.{port}", server.port)
        request.addfinalizer(lambda: server.__exit__())
        return server.__enter__()

    return make


@pytest.fixture
def opened(request):
    """Return what opens an arm with motion capture, and lines that it tells."""

    def make(name, spec=SPEC):
        lines = []
        arm = with_capture(Arm(), name, spec, lines.append)
        request.addfinalizer(arm._source.close)
        return arm, lines

    return make
