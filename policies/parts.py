"""Register the policies that ship."""

from alpasim_plugin.core.parts.registry import RegisteredPart

PARTS = (
    RegisteredPart(
        kind="policy",
        name="log-replay",
        target="policies.simple:LogReplay",
        help="the recorded ego poses, exactly; takes no camera",
    ),
    RegisteredPart(
        kind="policy",
        name="constant-velocity",
        target="policies.simple:ConstantVelocity",
        help="straight on at the present speed; takes no camera",
    ),
    RegisteredPart(
        kind="policy",
        name="pure-pursuit",
        target="policies.simple:PurePursuit",
        help="along the route at the initial speed, slower in curves; takes no camera",
    ),
    RegisteredPart(
        kind="policy",
        name="rule-based",
        target="policies.rule_based:RuleBased",
        help="along the route by the map and the boxes of road users: obeys lights and limits, gives way, keeps distance; takes no camera",
    ),
    RegisteredPart(
        kind="policy",
        name="lane-camera",
        target="policies.lane_camera:LaneCamera",
        help="lane markings and obstacles from one front camera, by OpenCV; the route is a weak prior",
    ),
    RegisteredPart(
        kind="policy",
        name="learned",
        target="policies.learned:Learned",
        help="a network trained on clean frames: one front camera, its speed, a command such as left-ahead",
    ),
    RegisteredPart(
        kind="policy",
        name="learned-mean",
        target="policies.learned:LearnedMean",
        help="the same network, driven by its mean prediction: every seed drives alike",
    ),
    RegisteredPart(
        kind="policy",
        name="learned-three",
        target="policies.learned:LearnedThree",
        help="a network that also sees cameras to the left and the right, and lets pass who comes from there",
    ),
)
