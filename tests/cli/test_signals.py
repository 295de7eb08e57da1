"""Signals stop a command in one way, and what started it decides which are ignored."""

import os
import signal
import subprocess
import sys
import time

import pytest

from alpasim_plugin.cli.signals import stoppable
from alpasim_plugin.core.errors import Stopped


@pytest.fixture
def nothing_ignored():
    """Default handlers, also where the tests were started under nohup, which ignores SIGHUP."""
    before = {
        one: signal.signal(one, signal.SIG_DFL)
        for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    yield
    for one, handler in before.items():
        signal.signal(one, handler)


@pytest.mark.usefixtures("nothing_ignored")
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_a_signal_unwinds_the_block_and_names_the_exit_code(number, code):
    before = {one: signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    unwound = False
    with pytest.raises(Stopped) as caught, stoppable():  # noqa: PT012 - the block is what is stopped
        try:
            os.kill(os.getpid(), number)
            time.sleep(60)
        finally:
            unwound = True
    assert unwound
    assert caught.value.exit_code == code
    assert number.name in str(caught.value)
    assert {one: signal.getsignal(one) for one in before} == before


def test_a_signal_that_was_ignored_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under nohup
    try:
        with stoppable():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_second_signal_ends_a_process_that_hangs_while_it_unwinds():
    code = (
        "import os, signal\n"
        "from alpasim_plugin.cli.signals import stoppable\n"
        "with stoppable():\n"
        "    try:\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n"
        "        signal.pause()\n"
        "    finally:\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n"
        "        signal.pause()\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 143
