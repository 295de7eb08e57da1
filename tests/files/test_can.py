"""CAN databases as vehicles have them: of floats, extended and CAN FD frames.

Every database is made here.
"""

from types import SimpleNamespace

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.cli.output import policy_notes
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts.resolve import unidentified

pytest.importorskip("cantools", reason="the extra [can] is not installed")
can = pytest.importorskip("can")

from alpasim_plugin.control.can_bus import Address, Exchange, open_bus  # noqa: E402
from alpasim_plugin.control.can_codec import load_map, open_codec  # noqa: E402

HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: SIM ECU\n'
EXTENDED = 1 << 31


def message(i, name, length, *signals):
    return f"BO_ {i} {name}: {length} ECU\n" + "".join(f" SG_ {one}\n" for one in signals) + "\n"


SPEED = 'SPEED : 0|16@1- (0.01,0) [-300|300] "" ECU'
ANGLE = 'ANGLE : 0|16@1- (0.1,0) [-900|900] "" SIM'
ACCEL = 'ACCEL : 16|16@1- (0.001,0) [-10|5] "" SIM'


def opened(folder, *parts, steer="", accel="", send=""):
    """Write a database and a map of it, and open both; the standard messages fill what is not
    given.
    """
    (folder / "car.dbc").write_text(HEAD + "".join(parts))
    send = send or "{message: EGO, period_us: 10000, signals: {SPEED: speed_kph}}"
    steer = steer or "{message: CMD, signal: ANGLE}"
    accel = accel or "{message: CMD, signal: ACCEL}"
    text = f"dbc: car.dbc\nsteering_ratio: 15\nsend: [{send}]\nsteer: {steer}\naccel: {accel}\n"
    (folder / "map.yaml").write_text(text)
    return open_codec(*load_map(str(folder / "map.yaml"))), folder / "map.yaml"


def answered(codec, *frames):
    """Send frames to one end of a bus and take them in at the other."""
    address = Address.parse(f"virtual:test-files-{id(frames)}")
    with open_bus(address, codec) as one, open_bus(address, codec) as other:
        exchange = Exchange(one, codec, timeout_s=0.01)
        for frame in frames:
            other.send(frame)
        exchange.commands = exchange.step(0, dict.fromkeys(("speed_kph",), 36.0))
        return exchange


EGO = message(257, "EGO", 4, SPEED)
CMD = message(512, "CMD", 4, ANGLE, ACCEL)


def test_one_message_may_carry_both_commands(tmp_path):
    codec, _ = opened(tmp_path, EGO, CMD)
    frame = codec.pack("CMD", {"ANGLE": 12.3, "ACCEL": -0.5}, None)
    got = answered(codec, frame).commands
    assert (got.mark, round(got.wheel_deg, 6), round(got.accel_mps2, 6)) == ("held", 12.3, -0.5)


@pytest.mark.parametrize("order", ["0|32@1", "7|32@0"])
def test_floats_go_out_and_come_in_as_floats(tmp_path, order):
    signal = f'{{}} : {order}- (1,0) [0|0] "" ECU'
    names = ("EGO", "SPEED"), ("STEER", "ANGLE"), ("ACC", "ACCEL")
    parts = [message(256 + i, m, 4, signal.format(s)) for i, (m, s) in enumerate(names)]
    parts += [f"SIG_VALTYPE_ {256 + i} {s} : 1;\n" for i, (_, s) in enumerate(names)]
    codec, _ = opened(
        tmp_path,
        *parts,
        steer="{message: STEER, signal: ANGLE}",
        accel="{message: ACC, signal: ACCEL}",
    )
    frame = codec.encode(codec.map.send[0], {"speed_kph": 36.04321})
    assert codec.message("EGO").decode(bytes(frame.data))["SPEED"] == pytest.approx(
        36.04321, rel=1e-6
    )
    steer = codec.encode_command(codec.map.steer, -12.3456)
    assert codec.decode(codec.map.steer, bytes(steer.data))[0] == pytest.approx(-12.3456, rel=1e-6)


def test_extended_and_standard_frames_of_one_number_are_two(tmp_path):
    codec, _ = opened(
        tmp_path,
        message(257 | EXTENDED, "EGO", 4, SPEED),
        message(512 | EXTENDED, "CMD", 4, ANGLE, ACCEL),
    )
    assert codec.encode(codec.map.send[0], {"speed_kph": 1.0}).is_extended_id
    frame = codec.pack("CMD", {"ANGLE": 1.0, "ACCEL": 0.5}, None)
    assert answered(codec, frame).commands.mark == "held"
    frame.is_extended_id = False
    exchange = answered(codec, frame)
    assert exchange.commands.mark == "ramped"
    assert exchange.counts["other"] == 1


def test_messages_longer_than_8_bytes_are_sent_as_can_fd(tmp_path):
    codec, _ = opened(tmp_path, message(257, "EGO", 16, SPEED), CMD)
    frame = codec.encode(codec.map.send[0], {"speed_kph": 1.0})
    assert (frame.is_fd, len(frame.data)) == (True, 16)
    assert codec.uses_fd
    assert not opened(tmp_path, EGO, CMD)[0].uses_fd


COUNTED = "{message: EGO, period_us: 10000, signals: {SPEED: speed_kph}, counter: COUNT}"
COUNT = 'COUNT : 16|4@1{} "" ECU'


def test_a_counter_counts_from_0_by_1(tmp_path):
    codec, _ = opened(
        tmp_path, message(257, "EGO", 4, SPEED, COUNT.format("+ (1,0) [0|15]")), CMD, send=COUNTED
    )
    frames = [codec.encode(codec.map.send[0], {"speed_kph": 1.0}) for _ in range(17)]
    assert [frame.data[2] for frame in frames] == [*range(16), 0]


STARTS = """BA_DEF_ SG_ "GenSigStartValue" FLOAT 0 100000;
BA_DEF_DEF_ "GenSigStartValue" 0;
BA_ "GenSigStartValue" SG_ 257 VALID 1;
BA_ "GenSigStartValue" SG_ 257 TEMP 60;
"""


def test_signals_that_a_map_does_not_name_have_the_start_value_of_the_database(tmp_path):
    more = ('VALID : 16|1@1+ (1,0) [0|1] "" ECU', 'TEMP : 24|8@1+ (1,-40) [-40|214] "" ECU')
    for starts, values in ((STARTS, (1, 20)), ("", (0, -40))):
        codec, _ = opened(tmp_path, message(257, "EGO", 4, SPEED, *more), CMD, starts)
        frame = codec.encode(codec.map.send[0], {"speed_kph": 36.0})
        sent = codec.message("EGO").decode(frame.data)
        assert (sent["VALID"], sent["TEMP"]) == values
        assert sent["SPEED"] == pytest.approx(36.0)


def test_a_start_value_beyond_the_range_of_its_signal_is_sent_as_it_is(tmp_path):
    """Databases put "not known" there."""
    starts = STARTS.replace("TEMP 60", "TEMP 255")
    more = ('VALID : 16|1@1+ (1,0) [0|1] "" ECU', 'TEMP : 24|8@1+ (1,-40) [-40|100] "" ECU')
    codec, _ = opened(tmp_path, message(257, "EGO", 4, SPEED, *more), CMD, starts)
    assert codec.encode(codec.map.send[0], {"speed_kph": 36.0}).data[3] == 255


TWO = message(
    257,
    "EGO",
    8,
    'KIND M : 0|8@1+ (1,0) [0|3] "" ECU',
    'SPEED m1 : 8|16@1- (0.01,0) [-300|300] "" ECU',
)


@pytest.mark.parametrize(
    ("parts", "keys", "found"),
    [
        ((TWO, CMD), {}, "EGO"),
        ((message(257, "EGO", 4, SPEED.replace("(0.01,0)", "(0,0)")), CMD), {}, "EGO"),
        ((message(257, "EGO", 1, SPEED), CMD), {}, "EGO"),
        ((EGO, CMD), {"steer": "{message: CMD, signal: WHEEL}"}, "WHEEL"),
        (
            (message(257, "EGO", 4, 'SPEED : 0|11@1+ (0.005,-1000) [0|2047] "" ECU'), CMD), {},
            "SPEED holds -1000 to -989.765, and not 0",
        ),
        (
            (EGO, message(512, "CMD", 4, ANGLE, 'ACCEL : 16|8@1+ (1,1) [1|200] "" SIM')), {},
            "ACCEL holds 1 to 200, and not 0",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_sent_is_refused_when_the_map_is_opened(tmp_path, parts, keys, found):
    with pytest.raises(InputError, match=found):
        opened(tmp_path, *parts, **keys)
    policy = f"can://virtual:files?map={tmp_path / 'map.yaml'}"
    command = ["--renderer", "clean", "--policy", policy, "--dry-run", "smoke/straight"]
    assert run_command([*command, "--out", str(tmp_path / "out")]) == 2


PROTECTED = """BA_DEF_ BO_ "E2EDataID" INT 0 65535;
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "E2EDataID" 0;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "E2EDataID" BO_ 257 12;
BA_ "GenMsgCycleTime" BO_ 257 10;
"""


def test_attributes_of_a_database_that_are_not_read_are_named_in_the_run(tmp_path):
    codec, path = opened(tmp_path, EGO, CMD, PROTECTED)
    note = "CAN database: not read are message@E2EDataID (1)"
    assert codec.notes == (note,)
    name = f"can://virtual:files?map={path}"
    plan = SimpleNamespace(policies=(unidentified("policy", name),))
    assert policy_notes(plan) == [f"{name}: {note}"]
