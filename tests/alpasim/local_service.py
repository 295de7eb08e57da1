"""Requests to a service that renders a scene of ours."""

from alpasim_plugin.log.schema import wire_render_request
from alpasim_plugin.runs.cameras import recorded_requests
from scenarios.load import load_scenario
from tests.alpasim.service_cases import pinhole

SCENE = "smoke/lead_car"
W = 64
H = 36


def ask(t_s=1.0, spec=None):
    """Return the request for the recorded pose after a time, with the moving cars."""
    scenario = load_scenario(SCENE)
    (request,) = recorded_requests(scenario, scenario.start_us + int(t_s * 1e6))
    asked = wire_render_request(scenario.scene_id, request, "png")
    asked.resolution_w, asked.resolution_h = W, H
    asked.camera_intrinsics.CopyFrom(spec or pinhole(W, H, "front"))
    return asked
