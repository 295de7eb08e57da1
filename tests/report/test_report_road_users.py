"""Other road users in the pictures from above."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.geometry import rectangle_corners
from alpasim_plugin.log.run_folder.writer import scene_as_json
from evaluators.report.birdseye import road_users
from scenarios.load import load_scenario


class Metres:
    """A drawing whose path data is in metres."""

    def path(self, xy):
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in xy)

    def box(self, centre, yaw_rad, size_m):
        return self.path(
            rectangle_corners(centre[None], np.array([yaw_rad]), np.array([size_m]))[0]
        )


def users_of(scenario, at_us):
    log = scenario.ego_log.xyz[:, :2]
    found = road_users(scene_as_json(scenario), at_us, log, Metres())
    return {one["text"].split(",")[0]: (one["body"], one["way"]) for one in found}


def test_a_leader_is_where_it_is_at_that_time_and_leaves_its_way():
    scenario = load_scenario("smoke/lead_car")
    (lead,) = [actor for actor in scenario.actors if actor.actor_id == "lead"]
    early, late = (
        users_of(scenario, t)[f"{lead.label} {lead.actor_id}"]
        for t in (scenario.start_us, scenario.end_us)
    )
    for (body, way), t_us in ((early, scenario.start_us), (late, scenario.end_us)):
        corners = np.array([[float(v) for v in pair.split(",")] for pair in body.split()])
        k = int(np.searchsorted(lead.track.t_us, t_us))
        assert (
            np.hypot(*(corners.mean(axis=0) - lead.track.xyz[min(k, len(lead.track) - 1), :2]))
            < 3.0
        )  # drawn every quarter of a second
        assert np.isclose(np.hypot(*(corners[0] - corners[1])), lead.box.width_m, atol=0.15)
        assert len(way.split()) > 10
    assert early[0] != late[0]
