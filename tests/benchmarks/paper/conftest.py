"""Fixtures of the tests of the paper's experiments."""

from html.parser import HTMLParser

import pytest


class Tags(HTMLParser):
    """Parser that checks that each tag is closed in its turn, and counts pictures."""

    def __init__(self):
        super().__init__()
        self.open, self.n_pictures, self.text = [], 0, ""

    def handle_starttag(self, tag, attrs):
        self.n_pictures += tag == "img" and dict(attrs)["src"].startswith("data:image/")
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="session")
def read_page():
    """Return a function: HTML file -> parsed page, with its text and number of pictures."""

    def read(path):
        page = Tags()
        page.feed(path.read_text("utf-8"))
        assert page.open == []
        return page

    return read
