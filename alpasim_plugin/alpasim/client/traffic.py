"""``--traffic HOST:PORT``: the road users that move are driven by AlpaSim's TrafficService; those that stand stay where they are.

The session gets the ego and every track, and the time of the hand-over. Each request holds the ego's pose; the reply holds the poses of all
other road users at that time, and a road user without a pose is absent.
"""

from __future__ import annotations

import itertools
import os
import uuid
from collections.abc import Mapping

from alpasim_plugin.alpasim.client.channel import Address, Service
from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.geometry import trajectory_from_poses
from alpasim_plugin.core.types import F64, EgoState, Scenario
from alpasim_plugin.log.schema import EGO, T_rig_box, header_from_scenario, read_transform, wire_traffic_session, wire_trajectory
from alpasim_plugin.wire import common_pb2, traffic_pb2
from alpasim_plugin.world.actors import Actors

DOING = "asking an AlpaSim traffic service"
_SESSIONS = itertools.count()


class RemoteActors(Actors):
    """Road users of one rollout behind a traffic service. Forecasts, which blocks of frames need, follow the recorded tracks.

    Args:
        scenario: What is driven; its reactive drivers are left to the service.
        address: ``HOST:PORT``.
        seed: The rollout's.

    Raises:
        InputError: The service does not have the scene, or needs a longer past than the scenario gives it.
        InfrastructureError: Nothing answers there, or a call fails.
    """

    def __init__(self, scenario: Scenario, address: str, seed: int) -> None:
        super().__init__(scenario.actors, scenario.vehicle, scenario.end_us)
        self._start_us, self._T_rig_box = scenario.start_us, T_rig_box(scenario.vehicle)
        self._moving = {actor.actor_id for actor in scenario.actors if not actor.is_static}
        self.service = Service("TrafficService", Address.parse("traffic", address, ()).target, InfrastructureError, retries=False)
        self.service.wait_ready()
        self._check(scenario)
        self._session = str(uuid.uuid5(uuid.NAMESPACE_URL, f"{scenario.scene_id}/{seed}/{os.getpid()}/{next(_SESSIONS)}"))
        header = header_from_scenario(scenario, self._session, seed & 0xFFFFFFFF, 0)
        self.service.call("start_session", wire_traffic_session(header))

    def step(self, t_us: int, ego: EgoState) -> Mapping[str, F64]:
        """Tell the service where the ego is and return everybody's pose at ``t_us``; the first step is that of the tracks."""
        poses = dict(super().step(t_us, ego))
        if t_us == self._start_us:
            return poses
        here = trajectory_from_poses([t_us], (ego.T_world_rig @ self._T_rig_box)[None])
        update = traffic_pb2.ObjectTrajectoryUpdate(object_id=EGO, trajectory=wire_trajectory(here, "the ego's box"))
        request = traffic_pb2.TrafficRequest(session_uuid=self._session, time_query_us=t_us, object_trajectory_updates=[update])
        answer = self.service.call("simulate", request, at_us=t_us)
        standing = {actor_id: pose for actor_id, pose in poses.items() if actor_id not in self._moving}
        return standing | self._moved(answer, t_us)

    def close(self) -> None:
        """Close the session and the channel."""
        try:
            self.service.call("close_session", traffic_pb2.TrafficSessionCloseRequest(session_uuid=self._session))
        finally:
            self.service.close()

    def _check(self, scenario: Scenario) -> None:
        facts = self.service.call("get_metadata", common_pb2.Empty())
        past_us = scenario.start_us + scenario.warmup_us - int(scenario.ego_log.t_us[0])
        if facts.minimum_history_length_us > past_us:
            found = (
                f"it needs {facts.minimum_history_length_us * 1e-6:g} s of the past, the scenario has {past_us * 1e-6:g} s at the hand-over"
            )
            raise InputError(DOING, self.service.target, found, "lengthen timing.warmup_us, or start later in the recording")
        known = self.service.call("get_available_scenes", common_pb2.Empty()).scene_ids
        if "*" not in known and scenario.scene_id not in known:
            found = f"no scene {scenario.scene_id!r} among its {len(known)}: {', '.join(sorted(known)[:5])}"
            raise InputError(DOING, self.service.target, found, "give the service that scene")

    def _moved(self, answer: traffic_pb2.TrafficReturn, t_us: int) -> dict[str, F64]:
        """Return the poses at exactly ``t_us``; later ones are a forecast, which nobody here uses."""
        out: dict[str, F64] = {}
        for update in answer.object_trajectory_updates:
            if update.object_id == EGO:
                continue
            now = [one.pose for one in update.trajectory.poses if int(one.timestamp_us) == t_us]
            if update.object_id not in self._moving or not now:
                found = f"track {update.object_id!r} " + (
                    f"without a pose at {t_us} us" if update.object_id in self._moving else "is unknown"
                )
                raise InfrastructureError(DOING, self.service.target, found, "see the service's own log")
            try:
                out[update.object_id] = read_transform(now[0], f"track {update.object_id!r} at {t_us} us")
            except InputError as error:
                found = f"{error.with_what}: {error.found}"
                raise InfrastructureError(DOING, self.service.target, found, "see the service's own log") from error
        return out
