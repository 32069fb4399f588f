"""A server of pages, and a headless browser; tests that need one are skipped where there is none."""

import shutil
import time
from multiprocessing import Pipe

import pytest

from mjx_softarm.view.channel import ChannelEnd

FLAGS = ("--no-sandbox", "--use-gl=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


def wait_for(condition, seconds=10.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def taken(end, name):
    """All values that come over a channel until one of this name does."""
    found = {}
    wait_for(lambda: found.update(end.take()) or name in found)
    return found


@pytest.fixture
def ends():
    """One end of a channel, and the connection of the other."""
    ours, theirs = Pipe()
    return ChannelEnd(ours), theirs


@pytest.fixture
def server():
    """A server without a page, on some free port."""
    from mjx_softarm.view.stage import open_server

    server = open_server("127.0.0.1", 8310, "")
    yield server
    server.stop()


@pytest.fixture(scope="session")
def browser():
    pytest.importorskip("viser", reason="needs viser: pip install -e '.[view]'")
    api = pytest.importorskip("playwright.sync_api", reason="needs Playwright: pip install -e '.[test]'")
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("needs a browser: apt install chromium")
    with api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield chromium
        chromium.close()
