"""What the tests of the paper's experiments share."""

from html.parser import HTMLParser

import pytest


class Tags(HTMLParser):
    """Sees that each tag is closed in its turn; counts pictures."""

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
    """A function: HTML file -> its text and number of pictures, once its tags are seen to be closed."""

    def read(path):
        page = Tags()
        page.feed(path.read_text("utf-8"))
        assert page.open == []
        return page

    return read
