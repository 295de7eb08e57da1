"""The command itself, as a process: it says where it listens, serves, and ends well on a signal.
And the commands of its page.
"""

import json
import re
import shlex
import signal
import subprocess
import sys

import grpc

from alpasim_plugin.cli.main import load_verb, verbs
from alpasim_plugin.log.wire import common_pb2
from alpasim_plugin.log.wire.services import Stub
from tests.alpasim.service_cases import answers, drive


def test_the_command_serves_until_it_is_stopped(upstream):
    command = [
        sys.executable,
        "-m",
        "alpasim_plugin.cli.main",
        "serve",
        "--listen",
        "127.0.0.1:0",
        "--renderer",
        "identity",
        "--json",
    ]
    with subprocess.Popen(
        [*command, "--upstream", upstream.address], stdout=subprocess.PIPE, text=True
    ) as process:
        opened = json.loads(process.stdout.readline())
        with grpc.insecure_channel(opened["at"]) as channel:
            stub = Stub(channel, "SensorsimService")
            assert (
                "identity"
                in stub.get_version(common_pb2.Empty(), timeout=60, wait_for_ready=True).version_id
            )
            assert len(answers(stub, drive(2))) == 2
        process.send_signal(signal.SIGTERM)
        counts = json.loads(process.stdout.readline())
        assert process.wait(30) == 0
    assert opened["serving"] == ["SensorsimService"]
    assert counts["failed"] == {}


def test_the_commands_of_the_page_are_valid(repo):
    """Every `simrun` line of the page parses; files and addresses in it are not touched."""
    page = (repo / "docs" / "alpasim.md").read_text()
    lines = [
        line.partition("#")[0]
        for block in re.findall(r"```bash\n(.*?)```", page, re.DOTALL)
        for line in block.splitlines()
    ]
    commands = [shlex.split(line)[1:] for line in lines if line.startswith("simrun ")]
    commands = [
        words for words in commands if words[0] in verbs()
    ]  # those of the laboratory are there where it is installed
    assert len(commands) >= 3
    for verb, *rest in commands:
        one = load_verb(verb)
        while hasattr(one, "commands"):
            one = one.commands[rest[0]]
            rest = rest[1:]
        one.make_context(verb, list(rest))
    modules = re.findall(r"python -m (alpasim_plugin[\w.]+)", page)
    assert modules
    for module in modules:
        assert (repo / (module.replace(".", "/") + ".py")).is_file()
