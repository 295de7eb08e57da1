"""The limits of a server that the page of security names are those of the code."""

import inspect
import re

from alpasim_plugin.alpasim.server import hosting, lens_cache, views
from alpasim_plugin.cli.serve import CALLS_AT_A_TIME
from alpasim_plugin.log.wire.services import MESSAGE_BYTES


def test_the_table_of_a_server_s_limits_is_that_of_the_code(repo):
    page = (repo / "docs" / "security.md").read_text()
    section = page.partition("## What a server promises")[2].partition("\n## ")[0]
    values = {
        name: [float(number.replace(",", "")) for number in re.findall(r"\d[\d,]*\.?\d*", value)]
        for name, value in re.findall(r"^\| ([^|]+?) \| ([^|]+?) \|", section, re.M)
    }
    of_a_policy = inspect.signature(hosting.Host).parameters["workers"].default
    assert values["calls that are worked on"] == [CALLS_AT_A_TIME, of_a_policy]
    of_a_message = [hosting.RENDER_BYTES / 2**20, MESSAGE_BYTES / 2**20]
    assert values["size of a message"] == of_a_message
    assert values["calls that wait, in all"] == [hosting.CALLS]
    assert values["calls on one connection"] == [hosting.STREAMS]
    assert values["sessions at a time"] == [hosting.SESSIONS]
    assert values["a handshake"] == [hosting.HANDSHAKE_S]
    assert values["messages that are received at a time"] == [hosting.RECEIVING]
    assert values["the time that a caller has to send one"] == [hosting.SENDING_S]
    assert values["answers that callers have not taken yet"] == [hosting.UNREAD_BYTES / 2**20]
    assert values["pixels of a frame"] == [
        views.MAX_SIDE_PX,
        views.MAX_SIDE_PX,
        round(views.MAX_PIXELS / 1e6, 1),
    ]
    assert values["memory for lenses that callers name"] == [lens_cache.LENS_BYTES / 2**20]
