"""What the evaluator of AlpaSim's challenge does beside a single session: two sessions at once, a
driver whose root cannot be written, and one that is started anew between sessions.

The sessions follow the recorded drive, so that their observations are the same whatever the driver
answers.
"""

import subprocess
import tempfile
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np

from alpasim_plugin.alpasim.client.channel import Address
from alpasim_plugin.alpasim.client.command import ENCODING, Command, CommandPolicy, Served
from alpasim_plugin.alpasim.client.driver import AlpasimPolicy, DriverPolicy
from alpasim_plugin.alpasim.client.preflight import Finding
from alpasim_plugin.core.errors import SimrunError
from alpasim_plugin.core.geometry import interpolate, trajectory_from_poses
from alpasim_plugin.core.recorded_state import ego_state_from_log
from alpasim_plugin.core.types import Observation, Plan, Scenario, read_only
from alpasim_plugin.runs.cameras import recorded_requests
from alpasim_plugin.runs.renderer import make_renderer
from alpasim_plugin.world.route import RouteAhead, from_offset

COMMAND = "exec:"  # before a command that simrun starts
QUERIES = 8  # of a session
SAME_M = 1e-3  # plans that differ by less are the same
INTERLEAVED = "two sessions, interleaved"
READ_ONLY = "a root that cannot be written"
ANEW = "started anew between sessions"
NOT_STARTED = (
    "not tried on a driver that runs already; check driver 'exec:COMMAND' starts it itself"
)

# As the challenge's containers have it (docker run --read-only --tmpfs /tmp --tmpfs /run), but for
# the size of /tmp, which holds the socket. $1 is the folder of temporary files.
READ_ONLY_SCRIPT = """
folder=$1; shift
mount --make-rprivate / && mount --bind /tmp /tmp && mount --bind "$folder" "$folder" || exit 97
mount -t tmpfs -o size=64m tmpfs /run || exit 97
while read -r _ place _; do
  case "$place" in
    /tmp|/tmp/*|"$folder"|"$folder"/*|/run|/run/*|/dev|/dev/*|/proc|/proc/*|/sys|/sys/*) ;;
    *) mount -o remount,bind,ro "$place" || exit 97 ;;
  esac
done < /proc/self/mounts
exec "$@"
"""
NAMESPACE = ("unshare", "--user", "--map-root-user", "--mount", "sh", "-c", READ_ONLY_SCRIPT, "sh")


def driver_at(scene: Scenario, address: str) -> DriverPolicy:
    """Return the driver at an address, or behind ``exec:COMMAND``."""
    if address.startswith(COMMAND):
        return CommandPolicy(scene, address.removeprefix(COMMAND))
    return AlpasimPolicy(scene, address)


def session_findings(scene: Scenario, address: str) -> list[Finding]:
    """Return what several sessions of a driver showed.

    Args:
        scene: Whose recorded drive they follow; it lasts twice `QUERIES` steps at least.
        address: As `driver_at` takes it.
    """
    if scene.recorded_until_us < scene.start_us + 2 * QUERIES * scene.rates.policy_us:
        text = f"not tried: scene {scene.scene_id!r} has fewer than {2 * QUERIES} queries"
        return [Finding(name, "noted", text) for name in (INTERLEAVED, READ_ONLY, ANEW)]
    driver = driver_at(scene, address)
    wanted = {sensor.camera for sensor in driver.sensors}
    driver.service.close()
    first, second = (_recorded(scene, wanted, skipped) for skipped in (0, QUERIES))
    findings = [_tried(INTERLEAVED, lambda: _two_at_once(scene, address, first, second))]
    if not address.startswith(COMMAND):
        return [*findings, *(Finding(name, "noted", NOT_STARTED) for name in (READ_ONLY, ANEW))]
    command = Command.parse(address.removeprefix(COMMAND))
    findings.append(_tried(READ_ONLY, lambda: _read_only(command, scene, first)))
    findings.append(_tried(ANEW, lambda: _anew(command, scene, first)))
    return findings


def _two_at_once(
    scene: Scenario, address: str, first: Sequence[Observation], second: Sequence[Observation]
) -> Finding:
    """Compare two sessions that are asked in turn with each of them alone."""
    alone = [_plans(driver_at(scene, address), scene, session) for session in (first, second)]
    drivers = (driver_at(scene, address), driver_at(scene, address))
    together = _interleaved(drivers, scene, first, second)
    off_m = max(_difference_m(*pair) for pair in zip(alone, together, strict=True))
    if off_m <= SAME_M:
        return Finding(INTERLEAVED, "passed", "each session plans as it does alone")
    again_m = _difference_m(alone[0], _plans(driver_at(scene, address), scene, first))
    if again_m > SAME_M:
        text = f"not comparable: its plans differ by {again_m:.2f} m between equal sessions"
        return Finding(INTERLEAVED, "noted", text)
    text = f"plans of a session differ by up to {off_m:.2f} m while another one is open"
    return Finding(INTERLEAVED, "failed", text)


def _recorded(scene: Scenario, wanted: Collection[str], skipped: int) -> list[Observation]:
    """Return the observations of `QUERIES` steps along the recorded drive from the step ``skipped``
    on, with the frames of the cameras that are wanted.
    """
    renderer = make_renderer("clean", scene)
    cameras = {camera.name: camera for camera in scene.cameras if camera.name in wanted}
    log = scene.ego_log
    route_ahead = RouteAhead(scene.route)
    observations = []
    for step in range(skipped + QUERIES):
        now = scene.start_us + step * scene.rates.policy_us
        ego = ego_state_from_log(log, now, scene.vehicle)
        route = from_offset(route_ahead.in_rig(ego.T_world_rig), scene.route_offset_m)
        if step < skipped:
            continue
        times = np.unique([*log.t_us[log.t_us <= now], now])
        history = trajectory_from_poses(times, interpolate(log, times))
        requests = [r for r in recorded_requests(scene, now) if r.camera.name in wanted]
        frames = {r.camera.name: read_only(renderer.render(r)) for r in requests}
        observations.append(Observation(now, frames, cameras, ego, history, route))
    return observations


def _plans(
    driver: DriverPolicy, scene: Scenario, observations: Sequence[Observation]
) -> list[Plan]:
    """Return the plans of one session, and close its channel."""
    try:
        driver.reset(0, scene.route)
        plans = [driver.act(observation) for observation in observations]
        driver.end({})
    finally:
        driver.service.close()
    return plans


def _interleaved(
    drivers: tuple[DriverPolicy, DriverPolicy],
    scene: Scenario,
    first: Sequence[Observation],
    second: Sequence[Observation],
) -> tuple[list[Plan], list[Plan]]:
    """Return the plans of two interleaved sessions: at each step both receive their observations,
    then both are asked for a plan.
    """
    plans: tuple[list[Plan], list[Plan]] = ([], [])
    try:
        for driver in drivers:
            driver.reset(0, scene.route)
        for step in zip(first, second, strict=True):
            for driver, observation in zip(drivers, step, strict=True):
                driver.tell(observation)
            for session, driver, observation in zip(plans, drivers, step, strict=True):
                session.append(driver.ask(observation))
        for driver in drivers:
            driver.end({})
    finally:
        for driver in drivers:
            driver.service.close()
    return plans


def _difference_m(plans: Sequence[Plan], others: Sequence[Plan]) -> float:
    """Return the largest distance between poses of plans of the same step; infinite where their
    times differ.
    """
    largest_m = 0.0
    for plan, other in zip(plans, others, strict=True):
        if not np.array_equal(plan.times_us, other.times_us):
            return float("inf")
        largest_m = max(largest_m, float(np.max(np.hypot(*(plan.xy - other.xy).T), initial=0.0)))
    return largest_m


def _read_only(command: Command, scene: Scenario, first: Sequence[Observation]) -> Finding:
    """Start the command where only its temporary folders can be written, and drive a session."""
    folder = tempfile.gettempdir()
    probe = subprocess.run(
        [*NAMESPACE, folder, "true"], capture_output=True, text=True, check=False
    )
    if probe.returncode != 0:
        text = "not tried: this machine lets nobody make one; start the container with --read-only"
        return Finding(READ_ONLY, "noted", text)
    served = Served(replace(command, words=(*NAMESPACE, folder, *command.words)))
    try:
        _plans(_driver_of(served, scene), scene, first)
    finally:
        served.stop()
    return Finding(READ_ONLY, "passed", "it serves where only /tmp and /run can be written")


def _anew(command: Command, scene: Scenario, first: Sequence[Observation]) -> Finding:
    """Drive the same session in two processes of the command, one after the other."""
    plans = []
    for _ in range(2):
        served = Served(command)
        try:
            plans.append(_plans(_driver_of(served, scene), scene, first))
            again_m = _difference_m(plans[-1], _plans(_driver_of(served, scene), scene, first))
        finally:
            served.stop()
    off_m = _difference_m(*plans)
    if off_m <= SAME_M:
        return Finding(ANEW, "passed", "a new process plans as the one before")
    if again_m > SAME_M:
        return Finding(ANEW, "noted", "not comparable: its plans differ between equal sessions")
    text = f"plans of a new process differ by up to {off_m:.2f} m from those of the one before"
    return Finding(ANEW, "failed", text)


def _driver_of(served: Served, scene: Scenario) -> DriverPolicy:
    options = {"encoding": ENCODING, **served.command.options}
    return DriverPolicy(scene, Address(served.address, options), None)


def _tried(name: str, check: Callable[[], Finding]) -> Finding:
    """Return what a check found; what the driver raises is its failure."""
    try:
        return check()
    except SimrunError as error:
        return Finding(name, "failed", error.message)
