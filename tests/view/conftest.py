"""A server of pages, and a headless browser; tests that need one are skipped where there is none."""

import shutil

import pytest

FLAGS = ("--no-sandbox", "--use-gl=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


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
    api = pytest.importorskip("playwright.sync_api", reason="needs Playwright: pip install playwright")
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("needs a browser: apt install chromium")
    with api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield chromium
        chromium.close()
