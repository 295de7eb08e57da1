"""The paper's claims, one for each sentence, as comparisons between arms: what must be better than
what, on which metric and protocol.

A metric that the paper measures with networks of others is replaced by ours (`published`), so a
claim is tested in the form that can be tested here. Like is compared with like: a rival that trains
its decoder meets our method with its decoder trained as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from alpasim_plugin.lab.learned_metrics.facts import STYLE_ACC, of_seed
from alpasim_plugin.lab.video_metrics.facts import KNOWN

Relation = Literal["better", "not better", "equal"]
FD = "fd_syn_clip"
PERCEPTUAL = "perceptual-syn"
CUBOID = "cuboid_f1_syn"
XERR = "lane_xerr_syn_m"
LANE = "lane_f1_syn"
FD_16 = "fd_syn_16"
MID, LAST = "perceptual-syn-mid", "perceptual-syn-last"
MOTION = "fvmd_lk"
WARP = "warp_l1_late_road"
PSNR = "psnr_db"
SSIM = "ssim"
MS = "ms_per_frame"
DRIFT = "drift_psnr_db"
COLLISION = "collision_at_fault"
OFFROAD = "offroad"
ROUTE = "route_distance_m"
STANDS_IN = {
    WARP: "warp_l1"
}  # where a record is older than the metric: the whole clip without a mask of the road
# least difference that matters: a tenth of what the shipped fixer gains over the render; of rates a
# third of the render's
MARGINS = {
    PSNR: 0.3,
    SSIM: 0.005,
    PERCEPTUAL: 0.02,
    MID: 0.02,
    LAST: 0.02,
    FD: 4.0,
    FD_16: 1.0,
    MOTION: 150.0,
    WARP: 7e-4,
    "warp_l1": 7e-4,
    LANE: 0.02,
    XERR: 0.015,
    CUBOID: 0.01,
    DRIFT: 0.3,
    MS: 1.0,
    STYLE_ACC: 0.05,
    COLLISION: 0.03,
    OFFROAD: 0.03,
    ROUTE: 0.1,
}

RAW, OURS, SHIPPED = (
    "3dgs",
    "V9",
    "onefixer[references=0]",
)  # the paper's method on the arms' backbone; as shipped, with the paper's inputs
PER_FRAME = "onefixer"  # the shipped generator, which was trained on its own history
DECODER = ", decoder trained"
OWN_DECODER = ("difix", "harmonizer", "harmonizer-temporal")  # train it with the rest
IMAGE = ("difix", "harmonizer", "harmonizer-temporal", "gsfix3d@8")
DISTILLED = ("self-forcing", "one-forcing")
CAUSAL = ("artifixer", "omnidreams@1", *DISTILLED)
ONE_STEP = (*OWN_DECODER, *CAUSAL)
VIDEO = ("3dgs-enhancer@8", "artifixer", "omnidreams@4")
ALL = ("gsfix3d@8", *ONE_STEP, "3dgs-enhancer@8", "omnidreams@4")
DRIVERS = (
    "learned",
    "lane-camera",
)  # policies that drive behind the arms; the paper's is another one
WINDOWS = tuple(f"under-trained, window {i}" for i in range(10))  # of 93 frames each


@dataclass(frozen=True)
class Comparison:
    """One comparison.

    Args:
        protocol: Which measurements: ``cycle``, ``under-trained`` (or one of its `WINDOWS`),
            ``map-error``, ``cost``, ``transfer``, ``appearance``, ``regime``, or what `behind` says
            of a policy in closed loop.
        metric: Ours.
        first, second: Arms.
        relation: ``better``: the first is better, and not by less than the margin; ``not better``:
            the opposite; ``equal``: the difference lies within the margin.
        bound: A value in the second arm's place, which is then named by it.
        share: By how much of the second's rate the first must be lower, 0 to 1.
    """

    protocol: str
    metric: str
    first: str
    second: str
    relation: Relation = "better"
    bound: float | None = None
    share: float = 0.0

    @property
    def arms(self) -> tuple[str, ...]:
        """Arms that must have been measured."""
        return (self.first,) if self.bound is not None else (self.first, self.second)


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper.

    Args:
        text: The sentence, shortened.
        where: Section, table or figure.
        comparisons: All must come out for it to hold.
        of_history: Whether it says what a history is worth: it is then judged only where the truth
            as history is worth the margin.
    """

    text: str
    where: str
    comparisons: tuple[Comparison, ...]
    of_history: bool = False


def behind(policy: str) -> str:
    """Return the name of the protocol in which a policy drives behind the arms."""
    return f"closed-loop, {policy}"


def within(arm: str) -> str:
    """Return the name of our method's last snapshot within half of an arm's core-minutes."""
    return f"{OURS}, half of {arm}'s core-minutes"


def margin(metric: str) -> float:
    """Return the least difference of a metric that matters, in its unit."""
    name = metric.removesuffix(of_seed("", 1))
    return MARGINS.get(name) or KNOWN.info(name).accepted


def each(
    protocols: str | Sequence[str],
    metrics: Sequence[str],
    firsts: str | Sequence[str],
    seconds: str | Sequence[str],
    relation: Relation = "better",
    share: float = 0.0,
) -> tuple[Comparison, ...]:
    """Return the comparisons of every first arm with every other second one, on every metric of
    every protocol.
    """
    protocols, firsts, seconds = (
        (x,) if isinstance(x, str) else x for x in (protocols, firsts, seconds)
    )
    return tuple(
        Comparison(protocol, metric, *_alike(first, second), relation, share=share)
        for protocol in protocols
        for metric in metrics
        for first in firsts
        for second in seconds
        if first != second
    )


def _alike(first: str, second: str) -> tuple[str, str]:
    """Return a pair of which our variants have their decoder trained where the other trains its
    own.
    """
    ours = [arm.startswith("V") for arm in (first, second)]
    if first in OWN_DECODER and ours[1]:
        return first, second + DECODER
    return (first + DECODER, second) if second in OWN_DECODER and ours[0] else (first, second)


BOTH = ("cycle", "under-trained")
LEARNED = behind("learned")
CLAIMS: tuple[Claim, ...] = (
    Claim(
        "Lowest FVD, LPIPS (and DISTS) of all under one-step inference",
        "abstract",
        each(BOTH, (FD, PERCEPTUAL), OURS, ONE_STEP),
    ),
    Claim(
        "Temporal consistency matches or exceeds multi-stage DMD pipelines",
        "abstract",
        each("cycle", (MOTION,), ("artifixer", *DISTILLED), OURS, "not better"),
    ),
    Claim(
        "Matches the final quality of Self-Forcing in under half the GPU-hours",
        "abstract",
        each("cost", (FD_16, PERCEPTUAL), "self-forcing", within("self-forcing"), "not better"),
    ),
    Claim(
        "Continues to improve beyond that plateau",
        "abstract",
        each("cost", (FD_16,), OURS, (within("self-forcing"), "self-forcing")),
    ),
    Claim(
        "Ends below both distilled baselines on FVD and FVMD",
        "efficiency",
        each("cost", (FD_16, MOTION), OURS, DISTILLED),
    ),
    Claim(
        "OmniDreams from four steps to one worsens FVD and FVMD",
        "introduction",
        each("cycle", (FD, MOTION), "omnidreams@4", "omnidreams@1"),
    ),
    Claim(
        "Better temporal consistency than image-based fixers",
        "Table 1",
        each("cycle", (MOTION, WARP), OURS, IMAGE),
    ),
    Claim(
        "Retains their frame-level fidelity",
        "Table 1",
        each("cycle", (PERCEPTUAL, PSNR), IMAGE, OURS, "not better"),
    ),
    Claim(
        "Better perceptual quality than bidirectional and causal video fixers",
        "Table 1",
        each("cycle", (PERCEPTUAL,), OURS, ("3dgs-enhancer@8", *CAUSAL, "omnidreams@4")),
    ),
    Claim(
        "Temporal Harmonizer wins Warp L1 on both datasets",
        "Table 1",
        each(BOTH, (WARP,), "harmonizer-temporal", (*ALL, OURS)),
    ),
    Claim(
        "It is otherwise no better than the frame-wise one",
        "Table 1",
        each(
            "cycle",
            (FD, PERCEPTUAL, PSNR, CUBOID, XERR),
            "harmonizer-temporal",
            "harmonizer",
            "not better",
        ),
    ),
    Claim(
        "Self-Forcing and One-Forcing have the best PSNR and SSIM",
        "Table 1, Waymo",
        each("cycle", (PSNR, SSIM), DISTILLED, (*VIDEO, OURS)),
    ),
    Claim(
        "They trail on FVD, LPIPS and FVMD",
        "Table 1, Waymo",
        each("cycle", (FD, PERCEPTUAL, MOTION), OURS, DISTILLED),
    ),
    Claim(
        "Over 900 frames it leads every metric but jitter and Warp L1",
        "Table 1, Seoul",
        each("under-trained", (FD, PERCEPTUAL, PSNR, SSIM, LANE, CUBOID, XERR, MOTION), OURS, ALL),
    ),
    Claim(
        "Lowest position-wise FVD throughout the 900 frames",
        "efficiency figure, b",
        each(WINDOWS, (FD_16,), OURS, ONE_STEP),
    ),
    Claim(
        "Substantially faster than video-based fixers",
        "efficiency figure, a",
        each("cycle", (MS,), OURS, ("3dgs-enhancer@8", "omnidreams@4", "artifixer-pre@4")),
    ),
    Claim(
        "Approaches the latency of image-based ones",
        "efficiency figure, a",
        tuple(Comparison("cycle", MS, arm, OURS, "not better") for arm in ("difix", "harmonizer")),
    ),
    Claim(
        "The DMD stage delivers a one-step gain",
        "efficiency",
        each("cycle", (FD,), "artifixer", "artifixer-pre@1"),
    ),
    Claim(
        "Collisions fall by a third behind it",
        "abstract, Table 2b",
        (
            *each(LEARNED, (COLLISION,), SHIPPED, RAW),
            *each(LEARNED, (COLLISION,), SHIPPED, RAW, share=1 / 3),
        ),
    ),
    Claim(
        "Off-road drives are halved",
        "closed loop, Table 2b",
        (
            *each(LEARNED, (OFFROAD,), SHIPPED, RAW),
            *each(LEARNED, (OFFROAD,), SHIPPED, RAW, share=1 / 2),
        ),
    ),
    Claim(
        "The route is kept: lowest deviation from the log",
        "closed loop, Table 2b",
        each(LEARNED, (ROUTE,), SHIPPED, RAW),
    ),
    Claim(
        "Lowest collisions, off-road and deviation of all renderers",
        "closed loop, Table 2b",
        each(
            LEARNED,
            (COLLISION, OFFROAD, ROUTE),
            OURS,
            (RAW, "difix", "omnidreams@4", "self-forcing"),
        ),
    ),
    Claim(
        "DiFix leaves the road less than the raw render",
        "closed loop, Table 2b",
        each([behind(p) for p in DRIVERS], (OFFROAD,), "difix", RAW),
    ),
    Claim(
        "and collides more",
        "closed loop, Table 2b",
        each([behind(p) for p in DRIVERS], (COLLISION,), RAW, "difix"),
    ),
    Claim(
        "OmniDreams and Self-Forcing stay close to the raw render",
        "closed loop, Table 2b",
        each(
            [behind(p) for p in DRIVERS],
            (COLLISION, OFFROAD),
            ("omnidreams@4", "self-forcing"),
            RAW,
            "equal",
        ),
    ),
    Claim(
        "From noise (V6) every metric collapses",
        "ablation",
        each("cycle", (FD, PERCEPTUAL, PSNR, CUBOID, MOTION), RAW, "V6"),
    ),
    Claim(
        "Own history in flow matching (V2) moves better than clean history (V1)",
        "ablation",
        each("cycle", (MOTION,), "V2", "V1"),
        True,
    ),
    Claim("It leaves a perceptual gap", "ablation", each("cycle", (PERCEPTUAL,), "V3", "V2")),
    Claim(
        "The pixel term alone (V3) is less consistent",
        "ablation",
        each("cycle", (MOTION, WARP), OURS, "V3"),
    ),
    Claim(
        "Both together (V9) give the best balance",
        "ablation",
        each("cycle", (FD,), OURS, ("V1", "V2", "V3")),
    ),
    Claim(
        "Two stages (V7) match its frames",
        "ablation",
        each("cycle", (PERCEPTUAL, PSNR), "V7", OURS, "equal"),
    ),
    Claim("but lose on FVD and FVMD", "ablation", each("cycle", (FD, MOTION), OURS, "V7")),
    Claim(
        "k = 1 (V4) worsens FVD and FVMD", "ablation", each("cycle", (FD, MOTION), OURS, "V4"), True
    ),
    Claim(
        "Re-denoised history (V8) degrades every metric",
        "ablation",
        each("cycle", (FD, PERCEPTUAL, CUBOID, MOTION), OURS, "V8"),
        True,
    ),
    Claim(
        "Without a map (V5) Cuboid F1, LPIPS and motion are worse",
        "ablation",
        each("cycle", (CUBOID, PERCEPTUAL, MOTION), OURS, "V5"),
    ),
    Claim(
        "V5 still beats every one-step baseline",
        "ablation",
        each("cycle", (FD, PERCEPTUAL, CUBOID), "V5", ONE_STEP),
    ),
    Claim(
        "Training on own rollouts beats training on clean history",
        "introduction",
        each("regime", (PSNR,), "V9-still", "V3b-still"),
        True,
    ),
    Claim(
        "Lane F1 stays above no map with lanes 0.5 m aside",
        "robustness",
        each("map-error", (LANE,), f"{OURS}, lanes 0.50 m aside", "V5"),
    ),
    Claim(
        "Cuboid F1 with boxes moved stays above no map",
        "robustness",
        each("map-error", (CUBOID,), f"{OURS}, boxes 0.35 m aside", "V5"),
    ),
    Claim(
        "A temporal Harmonizer trained on clean frames drifts, on its own outputs not",
        "drift figure",
        each("cycle", (DRIFT,), "harmonizer-temporal", "harmonizer-temporal-teacher"),
        True,
    ),
    Claim(
        "Beyond driving: best PSNR, LPIPS in the middle and at the end, and FVMD",
        "DL3DV table",
        each("transfer", (PSNR, MID, LAST, MOTION), OURS, ("difix", "artifixer")),
    ),
    Claim(
        "Asked for night, fog or snow it renders the style (here: nine frames of ten)",
        "appearance table",
        tuple(
            Comparison("appearance", metric, "appearance", "0.9", bound=0.9)
            for metric in (STYLE_ACC, of_seed(STYLE_ACC, 1))
        ),
    ),
    Claim(
        "and keeps the lanes (here: not below the raw render's by the formula)",
        "appearance table",
        each(
            "appearance", (LANE, of_seed(LANE, 1)), f"{RAW} + formula", "appearance", "not better"
        ),
    ),
)
