"""What tests read of a page and of the run that it is of."""

import json
from html.parser import HTMLParser

SMALL = [
    "iterations=12",
    "initialization.surfels=300",
    "checkpoint_seconds=0",
    "stages=[{until: 0.5, downscale: 2}, {views: 2}]",
    "minutes=null",
]


class Parsed(HTMLParser):
    """``figures``: data-figure -> value, ``words``: as it is shown; ``pictures``: their alt texts; ``addresses``: what a
    browser would load; ``links``; ``pre``: texts."""

    def __init__(self, text):
        super().__init__()
        self.figures, self.words, self.pictures, self.addresses, self.links, self.pre = {}, {}, [], [], [], []
        self._figure = self._in_pre = None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag == "data":
            self._figure = attributes["data-figure"]
            value = float(attributes["value"])
            assert self.figures.setdefault(self._figure, value) == value
        elif tag == "img" and "hidden" not in attributes:
            self.pictures.append(attributes["alt"])
        elif tag == "a":
            self.links.append(attributes["href"])
        elif tag == "pre":
            self._in_pre = True
            self.pre.append("")
        self.addresses += [attributes[name] for name in ("src", "srcset", "poster") if name in attributes]
        self.addresses += [attributes["href"]] if tag == "link" else []

    def handle_data(self, data):
        if self._figure:
            self.words[self._figure] = data
        if self._in_pre:
            self.pre[-1] += data

    def handle_endtag(self, tag):
        self._figure = None
        if tag == "pre":
            self._in_pre = None


def metrics(run):
    return json.loads((run / "metrics.json").read_text())
