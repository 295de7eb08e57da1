"""What a connection carries and where it goes: no fault of a connection is a policy's."""

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import resolve
from alpasim_plugin.log.wire.services import channel_options


def test_a_time_limit_that_is_no_number_is_bad_input():
    with pytest.raises(InputError, match="timeout_s"):
        resolve("policy", "alpasim://127.0.0.1:1?timeout_s=abc")


@pytest.mark.parametrize(
    ("target", "is_direct"),
    [("127.0.0.1:1", True), ("[::1]:1", True), ("localhost:1", True), ("host:1", False)],
)
def test_a_channel_to_this_machine_goes_through_no_proxy(target, is_direct):
    assert (("grpc.enable_http_proxy", 0) in channel_options(target)) == is_direct
