"""The parts that come with the package: name -> (factory, one line of help). Nothing is imported before a part is used."""

from __future__ import annotations

_PER_FRAME = "alpasim_plugin.fixers.per_frame:per_frame"
_BROKEN = "alpasim_plugin.renderers.broken:"

BUILTIN: dict[str, dict[str, tuple[str, str]]] = {
    "renderer": {
        "clean": ("alpasim_plugin.renderers.gaussian:CleanRenderer", "the Gaussian scene as built"),
        "3dgs": (
            "alpasim_plugin.renderers.reconstruction:reconstruction_renderer",
            "a reconstruction of the logged drive: error grows with the distance from its path",
        ),
        "nre://": ("alpasim_plugin.alpasim.client.renderer:NreRenderer", "an AlpaSim renderer service: nre://HOST:PORT[?scene=ID]"),
        "broken-black": (f"{_BROKEN}black_renderer", "deliberate fault: black frames"),
        "broken-mirrored": (f"{_BROKEN}mirrored_renderer", "deliberate fault: left and right swapped"),
        "broken-blurred": (f"{_BROKEN}blurred_renderer", "deliberate fault: strong blur"),
        "broken-shifted": (f"{_BROKEN}shifted_renderer", "deliberate fault: seen from 0.5 m to the right"),
        "broken-frozen": (f"{_BROKEN}frozen_renderer", "deliberate fault: the first frame for ever"),
        "broken-late": (f"{_BROKEN}late_renderer", "deliberate fault: images 1 s old"),
    },
    "fixer": {
        "onefixer": (_PER_FRAME, "one-step causal generator in pixels, frame by frame, for a CPU"),
        "onefixer-m": (_PER_FRAME, "the same at three times the work, for bfloat16 instructions or a GPU"),
        "nearest": ("alpasim_plugin.fixers.nearest:NearestFixer", "the nearest recorded frame, warped into the view, without a network"),
        "identity": ("alpasim_plugin.fixers.identity:IdentityFixer", "passes frames on unchanged"),
    },
    "policy": {
        "log-replay": ("policies.simple:LogReplay", "the recorded ego poses, exactly; takes no camera"),
        "constant-velocity": ("policies.simple:ConstantVelocity", "straight on at the present speed; takes no camera"),
        "pure-pursuit": ("policies.simple:PurePursuit", "along the route at the initial speed, slower in curves; takes no camera"),
        "lane-camera": (
            "policies.lane_camera:LaneCamera",
            "lane paint and obstacles from one front camera, by OpenCV; the route is a weak prior",
        ),
        "learned": (
            "policies.learned:Learned",
            "a network trained on clean frames: one front camera, its speed, a command such as left-ahead",
        ),
        "alpasim://": (
            "alpasim_plugin.alpasim.client.driver:AlpasimPolicy",
            "an AlpaSim driver: alpasim://HOST:PORT[?cameras=THEIRS:OURS,...]",
        ),
        "exec:": (
            "alpasim_plugin.alpasim.client.command:CommandPolicy",
            "a command that serves a policy, in another environment or a container: 'exec:python my_policy.py'",
        ),
        "can://": (
            "alpasim_plugin.control.can_policy:CanPolicy",
            "a control unit on a CAN bus: can://[INTERFACE:]CHANNEL[?map=NAME&dbc=FILE]",
        ),
        "learned-mean": ("policies.learned:LearnedMean", "the same network, driven by its mean prediction: every seed drives alike"),
    },
    "controller": {
        "bicycle": (
            "alpasim_plugin.control.tracker:PlanTracker",
            "kinematic bicycle that follows the plan with preview, within the vehicle's limits",
        ),
        "vdc://": (
            "alpasim_plugin.alpasim.client.world_services:VdcController",
            "an AlpaSim controller, and physics: vdc://HOST:PORT[?physics=HOST:PORT&scene=ID]",
        ),
        "perfect": ("alpasim_plugin.control.base:PerfectController", "the ego is exactly where its plan says"),
    },
    "evaluator": {
        "collision": ("evaluators.metrics.collision:FACTORY", "contact with other actors by class, and the distance to them"),
        "offroad": ("evaluators.metrics.offroad:FACTORY", "off-road, wrong lane and the distance to the lanes' border"),
        "route": ("evaluators.metrics.route:FACTORY", "distance from the recorded drive, progress and distance driven"),
        "outcomes": ("evaluators.metrics.outcomes:FACTORY", "standstill and braking without a cause, and leaving the route"),
        "motion": ("evaluators.metrics.motion:FACTORY", "comfort, hard braking, time to collision, safe distance, wrong way and red light"),
        "protocols": ("evaluators.scores.protocols:FACTORY", "scores of nuPlan, NAVSIM, HUGSIM and NeuroNCAP"),
        "plan": ("evaluators.metrics.plan:FACTORY", "plan deviation, open-loop collision and minADE of the plans"),
        "image_health": ("evaluators.metrics.image_health:FACTORY", "black and frozen camera images"),
    },
    "source": {
        "argoverse": ("scenarios.sources:Argoverse", "Argoverse 2 log folder"),
        "commonroad": ("scenarios.sources:CommonRoad", "CommonRoad XML"),
        "cosmos": ("scenarios.sources:Cosmos", "Cosmos-Drive-Dreams clip folder"),
        "drive": ("scenarios.sources:ImportedDrive", "folder that simrun import has written"),
        "usdz": ("scenarios.sources:Usdz", "AlpaSim scene"),
    },
}
