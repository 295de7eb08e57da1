"""The CAN bus: frames, databases, and what happens to commands that are lost, late, wrong or
missing.
"""

import threading
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.runs.rollout import run_rollout
from scenarios.load import load_scenario

pytest.importorskip(
    "cantools", reason="cantools is not installed: pip install 'alpasim-onefixer[can]'"
)
can = pytest.importorskip("can")

from alpasim_plugin.control.bicycle import BicycleState  # noqa: E402
from alpasim_plugin.control.can_bus import (  # noqa: E402
    HOLD_US,
    SILENT_US,
    STOP_MPS2,
    Address,
    Exchange,
    open_bus,
)
from alpasim_plugin.control.can_codec import load_map, open_codec  # noqa: E402
from alpasim_plugin.control.can_policy import CanPolicy, path_cubic, quantities  # noqa: E402
from alpasim_plugin.core.types import EgoState, HeightField, Observation, Vehicle  # noqa: E402
from tests.control.can_ecu import LaneKeeper, serve  # noqa: E402


class NoCamera(Renderer):
    def render(self, request):
        raise AssertionError("nothing is rendered for a policy without cameras")


def example(echoes=True):
    """Open the shipped map; without echoes, a command is for the instant at which it comes."""
    can_map, database = load_map("example")
    silent = {} if echoes else {"echo": None}
    parts = {name: getattr(can_map, name).model_copy(update=silent) for name in ("steer", "accel")}
    return open_codec(can_map.model_copy(update=parts), database)


@pytest.fixture
def codec():
    return example(echoes=False)


@pytest.fixture
def wires(request):
    """Two ends of a virtual bus."""
    address = Address.parse(f"virtual:test-{request.node.name}")
    with open_bus(address) as one, open_bus(address) as other:
        yield one, other


def exchange(codec, bus):
    return Exchange(bus, codec, timeout_s=0.001)


def send(bus, frame_id, data):
    bus.send(can.Message(arbitration_id=frame_id, data=data, is_extended_id=False))


def commands(codec, wheel_deg, accel_mps2, echo=0):
    return [
        codec.encode_command(codec.map.steer, wheel_deg, echo),
        codec.encode_command(codec.map.accel, accel_mps2, echo),
    ]


NOTHING = quantities(BicycleState(0, 0, 0, 10.0, 0.0), 0.0, 0.0, np.zeros((0, 3)), 15.0, Vehicle())


# --- frames


def test_a_signal_carries_the_nearest_value_that_it_can_hold(codec):
    message = codec.message("EGO_MOTION")
    step = float(message.get_signal_by_name("SPEED").scale)
    for speed_kph in np.linspace(0.1, 120.0, 50):
        data = codec.encode(codec.map.send[0], NOTHING | {"speed_kph": speed_kph}).data
        assert abs(message.decode(data)["SPEED"] - speed_kph) <= step * (0.5 + 1e-6)
    data = codec.encode(codec.map.send[0], NOTHING | {"speed_kph": 1e6}).data
    assert message.decode(data)["SPEED"] < 1000.0


def test_databases_that_do_not_fit_are_refused(shared_data, tmp_path):
    folder = shared_data / "opendbc"
    # The second has a pseudo message with an impossible identifier.
    for name in ("comma_body.dbc", "toyota_2017_ref_pt.dbc"):
        with pytest.raises(InputError):
            open_codec(*load_map("example", str(folder / name)))
    (tmp_path / "no.dbc").write_text("not a database")
    with pytest.raises(InputError):
        open_codec(*load_map("example", str(tmp_path / "no.dbc")))
    with pytest.raises(InputError, match="example"):
        load_map("volvo")
    with pytest.raises(InputError):
        load_map("example", str(tmp_path / "absent.dbc"))


# --- commands


def test_commands_that_answer_are_fresh(codec, wires):
    bus, unit = wires
    one = exchange(codec, bus)
    sent = open_codec(*load_map("example"))
    for i in range(3):
        for frame in commands(sent, 12.3, -0.7):
            unit.send(frame)
        got = one.step(10_000 * i, NOTHING)
        assert (got.wheel_deg, got.accel_mps2) == (pytest.approx(12.3), pytest.approx(-0.7))
    assert one.counts["late"] == 6  # they came before the instant that they were taken for
    assert one.counts["lost"] == one.counts["malformed"] == 0


def test_a_missing_command_is_held_and_then_the_brake_grows(codec, wires):
    bus, unit = wires
    one = exchange(codec, bus)
    for frame in commands(open_codec(*load_map("example")), 5.0, 1.0):
        unit.send(frame)
    got = [one.step(t, NOTHING) for t in range(0, HOLD_US + 2_000_000, 50_000)]
    held = HOLD_US // 50_000 + 1
    assert [g.mark for g in got] == ["held"] * held + ["ramped"] * (len(got) - held)
    assert [g.accel_mps2 for g in got[:held]] == pytest.approx([1.0] * held)
    braking = [g.accel_mps2 for g in got[held:]]
    assert braking == sorted(braking, reverse=True)
    assert braking[0] == pytest.approx(-0.1)
    assert braking[-1] == STOP_MPS2
    assert [g.wheel_deg for g in got] == pytest.approx([5.0] * len(got))
    assert one.counts["held"] == held


def test_the_vehicle_brakes_although_one_of_the_two_commands_still_comes(codec, wires):
    bus, unit = wires
    ends = exchange(codec, bus)
    sender = example(echoes=False)
    marks = []
    for t_us in range(0, HOLD_US + 200_000, 50_000):
        steer, accel = commands(sender, 5.0, 1.0)
        unit.send(steer)
        if t_us == 0:
            unit.send(accel)
        marks.append(ends.step(t_us, NOTHING).mark)
    held = HOLD_US // 50_000 + 1
    assert marks == ["held"] * held + ["ramped"] * (len(marks) - held)


def test_without_any_command_the_vehicle_brakes(codec, wires):
    bus, unit = wires
    one = exchange(codec, bus)
    unit.send(codec.pack("ACCEL_CMD", {"ACCEL": 1.0, "ENABLE": 0}, "COUNTER"))  # it is starting
    got = [one.step(t, NOTHING) for t in (0, 1_000_000, 3_000_000)]
    assert [(g.mark, round(g.accel_mps2, 6)) for g in got] == [
        ("ramped", 0.0),
        ("ramped", -2.0),
        ("ramped", STOP_MPS2),
    ]


def test_a_vehicle_that_brakes_hard_is_not_let_go(codec, wires):
    bus, unit = wires
    one = exchange(codec, bus)
    for frame in commands(example(), 0.0, -6.0):
        unit.send(frame)
    got = [one.step(t, NOTHING).accel_mps2 for t in range(0, 2_000_000, 50_000)]
    assert got == pytest.approx([-6.0] * len(got))


def test_a_unit_that_sends_no_command_at_all_is_named(codec, wires):
    one = exchange(codec, wires[0])
    for t_us in range(0, SILENT_US, 50_000):
        one.step(t_us, NOTHING)
    with pytest.raises(InfrastructureError, match=r"STEER_CMD .0x200., ACCEL_CMD .0x201."):
        one.step(SILENT_US, NOTHING)
    short = exchange(codec, wires[0])
    short.step(0, NOTHING)
    with pytest.raises(InfrastructureError, match="no command"):
        short.finish()


# --- instants


@pytest.mark.parametrize("start_us", [0, 505_000, 1_700_000_000_123_457])
def test_messages_are_due_at_multiples_of_their_periods_after_the_first_instant(start_us):
    can_map, database = load_map("example")
    periods = (15_000, 25_000, 10_000, 40_000)
    send = tuple(
        sent.model_copy(update={"period_us": period})
        for sent, period in zip(can_map.send, periods, strict=True)
    )
    codec = open_codec(can_map.model_copy(update={"send": send}), database)
    address = Address.parse(f"virtual:test-periods-{start_us}")
    with open_bus(address) as bus, open_bus(address) as unit:
        one = exchange(codec, bus)
        sent_at = {codec.address(sent.message)[0]: [] for sent in send}
        for query in (0, 100_000):
            for t_us in one.instants(start_us + query, start_us + query + 100_000):
                one.step(t_us, NOTHING)
                while (frame := unit.recv(0)) is not None:
                    sent_at[frame.arbitration_id].append(t_us - start_us)
                for frame in commands(codec, 0.0, 0.0, codec._counters["EGO_STEER"]):
                    unit.send(frame)
    assert list(sent_at.values()) == [list(range(0, 200_000, period)) for period in periods]


def test_a_command_counts_for_the_instant_that_it_repeats(wires):
    bus, unit = wires
    codec = example()
    one = exchange(codec, bus)
    sent = example()
    for frame in commands(sent, 1.0, 0.1, echo=7):  # of a rollout before
        unit.send(frame)
    assert one.step(0, NOTHING).mark == "ramped"
    assert one.counts["stale"] == 2
    for frame in commands(sent, 2.0, 0.2, echo=0):
        unit.send(frame)
    got = one.step(10_000, NOTHING)
    assert (got.mark, got.wheel_deg) == ("held", pytest.approx(2.0))
    assert one.counts["late"] == 2


def test_a_late_answer_of_a_rollout_is_no_command_of_the_next():
    scenario = load_scenario("smoke/straight")
    address = "virtual:test-late"
    policy = CanPolicy(scenario, f"{address}?timeout_ms=1")
    with open_bus(Address.parse(address)) as unit:
        for frame in commands(example(), 90.0, -6.0):
            unit.send(frame)
        policy.reset(0, scenario.route)
        assert policy._bus.recv(0) is None
    policy.close()


def test_a_channel_belongs_to_one_rollout_at_a_time():
    scenario = load_scenario("smoke/straight")
    first, second = (CanPolicy(scenario, "virtual:test-own") for _ in range(2))
    first.reset(0, scenario.route)
    with pytest.raises(InfrastructureError, match="another rollout drives on this channel"):
        second.reset(0, scenario.route)
    first.end({})
    second.reset(0, scenario.route)
    for policy in (first, second):
        policy.close()


@pytest.mark.parametrize(
    "address",
    ["can0", "pcan:PCAN_USBBUS1", "socketcn:can0", "virtual:", ":can0", "virtual:a?timeout_ms=²"],
)
def test_an_address_is_refused_unless_it_names_an_interface_and_a_channel(address):
    with pytest.raises(InputError, match=r"write can://INTERFACE:CHANNEL"):
        Address.parse(address)


def test_every_fault_is_counted_by_cause(codec, wires):
    bus, unit = wires
    one = exchange(codec, bus)
    other = open_codec(*load_map("example"))
    frames = [commands(other, 1.0, 0.5) for _ in range(6)]
    for frame in frames[0]:
        unit.send(frame)
        unit.send(frame)  # the same counter again
    for frame in frames[3]:  # two of each lost
        unit.send(frame)
    steer_id = frames[4][0].arbitration_id
    data = bytes(frames[4][0].data)
    send(unit, steer_id, data[:5])  # cut short
    unit.send(other.pack("ACCEL_CMD", {"ACCEL": 1.0, "ENABLE": 0}, "COUNTER"))
    raw = other.message("ACCEL_CMD").encode(
        {"ACCEL": -30.0, "ENABLE": 1, "COUNTER": 9, "ECHO": 0}, strict=False
    )
    send(unit, frames[4][1].arbitration_id, raw)
    send(unit, 0x7AB, b"\1\2")  # of nobody here
    got = one.step(0, NOTHING)
    wanted = {
        "repeated": 2,
        "lost": 4,
        "malformed": 1,
        "not_enabled": 1,
        "out_of_range": 1,
        "other": 1,
    }
    assert {name: one.counts[name] for name in wanted} == wanted
    assert (got.wheel_deg, got.accel_mps2) == (pytest.approx(1.0), pytest.approx(0.5))


# --- driving


def test_the_path_is_the_routes_cubic():
    x = np.linspace(0.0, 60.0, 40)
    y = 0.4 + 0.03 * x + 0.004 * x**2 / 2 - 1e-5 * x**3 / 6
    path = np.column_stack([x, y, np.zeros(40)])
    found = path_cubic(path, BicycleState(0.0, 0.0, 0.0, 10.0, 0.0))
    assert_allclose(found[:4], (0.4, 0.03, 0.004, -1e-5), rtol=1e-6)
    assert path_cubic(path[:2], BicycleState(0, 0, 0, 10.0, 0.0)) == (0.0,) * 5


@pytest.fixture
def curve():
    return load_scenario("smoke/curve", overrides=("timing.duration_us=4000000",))


def drive(scenario, name):
    """Drive over a bus of two threads; return the driven path and the policy's facts."""
    stop = threading.Event()
    address = Address.parse(name)
    with open_bus(address) as bus:
        unit = threading.Thread(
            target=serve, args=(bus, LaneKeeper(open_codec(*load_map("example"))), stop)
        )
        unit.start()
        try:
            policy = CanPolicy(scenario, f"{name}?timeout_ms=5000")
            log = run_rollout(scenario, NoCamera(), policy).log()
        finally:
            stop.set()
            unit.join()
    return log, policy.facts()


@pytest.mark.slow
def test_a_control_unit_drives_a_curve_and_twice_the_same(curve):
    log, facts = drive(curve, "virtual:test-drive-one")
    assert facts["frames"]["fresh"] == 400  # every 10 ms of 4 s
    assert set(facts["frames"]) == {"sent", "fresh", "lost"}
    assert facts["frames"]["lost"] == 0
    assert 0 < facts["latency_ms"]["p50"] <= facts["latency_ms"]["p99"]
    ends = log.ego.xyz[-1, :2]
    gap = np.linalg.norm(log.ego_log.xyz[:, :2] - ends, axis=1).min()
    assert gap < 2.5  # box centre against rear axle: 1.4 m, and the curve's cut
    turned = 2 * np.arccos(abs(float(np.dot(log.ego.quat[0], log.ego.quat[-1]))))
    assert turned > 0.05  # it steered
    again, _ = drive(curve, "virtual:test-drive-two")
    assert_array_equal(log.ego.xyz, again.ego.xyz)


def test_a_rollout_without_a_control_unit_is_a_failure_of_the_machine():
    scenario = load_scenario(
        "smoke/straight", overrides=("timing.duration_us=3000000", "timing.warmup_us=200000")
    )
    policy = CanPolicy(scenario, "virtual:test-nobody?timeout_ms=1")
    with pytest.raises(InfrastructureError, match="the control unit sent no command"):
        run_rollout(scenario, NoCamera(), policy)
    policy.close()


def steady(policy, accel_mps2):
    """Let a policy's bus answer every instant with one acceleration."""
    exchange = policy._exchange

    def wait(t_us):
        for command, value in ((exchange._steer, 0.0), (exchange._accel, accel_mps2)):
            command.value, command.t_us = value, t_us
        exchange._has_answered = True
        return False

    exchange._wait = wait


def pose_at(x_m, y_m, yaw_rad):
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]]
    T[:2, 3] = x_m, y_m
    return T


def test_a_plan_begins_with_the_wheels_of_the_last_one_where_the_ego_is_at_its_end(curve):
    def observation(ego):
        return Observation(ego.t_us, {}, {}, ego, curve.ego_log, np.zeros((0, 3)))

    policy = CanPolicy(curve, "virtual:test-next-plan")
    policy.reset(0, curve.route)
    steady(policy, 1.0)
    start = EgoState(1_000_000, pose_at(40.0, -20.0, 2.9), speed_mps=20.0, yaw_rate_radps=1.0)
    plan = policy.act(observation(start))
    end_us = start.t_us + curve.rates.policy_us
    end = int(np.flatnonzero(plan.times_us == end_us)[0])
    assert plan.xy[end, 1] > 0.05
    pose = start.T_world_rig @ pose_at(*plan.xy[end], plan.yaw[end])
    ego = EgoState(end_us, pose, speed_mps=9.0)
    state = policy._start(observation(ego))
    assert state.speed_mps == pytest.approx(20.0 + curve.rates.policy_us * 1e-6)
    assert state.steer_rad > 0.0
    assert policy._steer_rate < 0.0  # the unit turns the wheels back
    state = policy._start(observation(replace(ego, T_world_rig=pose @ pose_at(0.0, 0.5, 0.0))))
    assert (state.speed_mps, state.steer_rad, policy._steer_rate) == (9.0, 0.0, 0.0)
    policy.close()


@pytest.mark.parametrize("slope", [0.0, 0.05, -0.05])
@pytest.mark.parametrize("accel_mps2", [1.0, -2.0])
def test_acceleration_on_a_slope_is_what_the_unit_commands(slope, accel_mps2):
    flat = load_scenario(
        "smoke/straight", overrides=("timing.duration_us=2000000", "timing.warmup_us=200000")
    )
    x_m = flat.ego_log.xyz[:, 0]
    z = slope * (np.arange(1200.0) - 600.0)
    ground = HeightField(-600.0, -600.0, 1.0, np.tile(z, (1200, 1)))
    scenario = replace(flat, ground=ground)
    policy = CanPolicy(scenario, f"virtual:test-slope-{slope}-{accel_mps2}")
    reset = policy.reset

    def reset_and_answer(seed, route):
        reset(seed, route)
        steady(policy, accel_mps2)

    policy.reset = reset_and_answer
    log = run_rollout(scenario, NoCamera(), policy).log()
    policy.close()
    assert np.ptp(x_m) > 10.0
    t_s = log.ego.t_us * 1e-6
    speed = np.linalg.norm(np.diff(log.ego.xyz[:, :2], axis=0), axis=1) / np.diff(t_s)
    begin, end = np.searchsorted(t_s, (t_s[0] + 0.9, t_s[0] + 1.8))
    gained = (speed[end] - speed[begin]) / (t_s[end] - t_s[begin])
    assert gained == pytest.approx(accel_mps2, rel=0.02)
