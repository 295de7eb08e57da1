"""The paper's claims as comparisons between arms: what must be better than what, on which metric, under which protocol.

The list is that of the paper's text and tables, in the words of our metrics. A metric that the paper measures with networks of others
is replaced by ours (`published`), so a claim is tested in the form that can be tested here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from alpasim_plugin.lab.learned_metrics.facts import STYLE_ACC, of_seed

Relation = Literal["better", "not better", "close"]
FD, PERCEPTUAL, CUBOID, XERR, LANE, JITTER = (
    "fd_syn_clip", "perceptual-syn", "cuboid_f1_syn", "lane_xerr_syn_m", "lane_f1_syn", "lane_jitter_syn_m",
)  # fmt: skip
MID, LAST = "perceptual-syn-mid", "perceptual-syn-last"
MOTION, WARP, PSNR, SSIM, MS, DRIFT = "fvmd_lk", "warp_l1", "psnr_db", "ssim", "ms_per_frame", "drift_psnr_db"
CLOSE = 0.10  # share of the second arm's value below which a difference counts as none

ONE_STEP = ("difix", "harmonizer", "harmonizer-temporal", "artifixer", "omnidreams@1", "self-forcing", "one-forcing")
ALL_ARMS = ("gsfix3d@8", *ONE_STEP, "3dgs-enhancer@8", "artifixer-pre@1", "artifixer-pre@4", "omnidreams@4")
LONG_ARMS = tuple(arm for arm in ALL_ARMS if not arm.startswith("artifixer-pre"))
DISTILLED = ("self-forcing", "one-forcing")
OURS = "V9"  # the paper's own method on the shared backbone
FD_16 = "fd_syn_16"
DRIVERS = ("learned", "lane-camera")  # policies that drive behind the arms; the paper's is another one


@dataclass(frozen=True)
class Comparison:
    """One comparison.

    Args:
        protocol: Which measurements: ``cycle``, ``under-trained``, ``map-error``, ``cost``, ``transfer``, ``appearance``, or what
            `behind` says of a policy in closed loop.
        metric: Ours.
        first, second: Arms.
        relation: ``better``: the paired difference favours the first; ``not better``: it does not; ``close``: its interval lies within a
            tenth of the second's value.
        bound: A value in the second arm's place, which is then named by it.
    """

    protocol: str
    metric: str
    first: str
    second: str
    relation: Relation = "better"
    bound: float | None = None

    @property
    def arms(self) -> tuple[str, ...]:
        """Arms that must have been measured."""
        return (self.first,) if self.bound is not None else (self.first, self.second)


@dataclass(frozen=True)
class Claim:
    """A claim of the paper.

    Args:
        number: In the order of the paper.
        text: The claim.
        where: Table or figure.
        comparisons: All must come out for the claim to hold.
    """

    number: int
    text: str
    where: str
    comparisons: tuple[Comparison, ...]


def behind(policy: str) -> str:
    """Return the name of the protocol in which a policy drives behind the arms."""
    return f"closed-loop, {policy}"


def within(arm: str) -> str:
    """Return the name of our method's last snapshot within half of an arm's core-minutes."""
    return f"{OURS}, half of {arm}'s core-minutes"


def each(protocol: str, metrics: Sequence[str], first: str, rivals: Sequence[str], relation: Relation = "better") -> tuple[Comparison, ...]:
    """Return the comparisons of an arm with every rival on every metric."""
    return tuple(Comparison(protocol, metric, first, rival, relation) for metric in metrics for rival in rivals)


CLAIMS: tuple[Claim, ...] = (
    Claim(
        1, "OneFixer is best on FVD, LPIPS, DISTS, Cuboid F1 and lane x-error (Waymo), on all but jitter and Warp L1 (Seoul)", "Table 1",
        (
            *each("cycle", (FD, PERCEPTUAL, CUBOID, XERR), OURS, ALL_ARMS),
            *each("under-trained", (FD, PERCEPTUAL, CUBOID, XERR, PSNR, SSIM, LANE, MOTION), OURS, LONG_ARMS),
        ),
    ),
    Claim(
        2, "Distilled arms have the best PSNR and SSIM, and worse LPIPS, DISTS, FVD and FVMD than OneFixer", "Table 1, Waymo",
        (
            *(comparison for arm in DISTILLED for comparison in each("cycle", (PSNR, SSIM), arm, (OURS,))),
            *each("cycle", (PERCEPTUAL, FD, MOTION), OURS, DISTILLED),
        ),
    ),
    Claim(
        3, "Temporal Harmonizer has the best Warp L1 and is otherwise no better than the frame-wise one", "Table 1",
        (
            *each("cycle", (WARP,), "harmonizer-temporal", (*(arm for arm in ALL_ARMS if arm != "harmonizer-temporal"), OURS)),
            *each("cycle", (FD, PERCEPTUAL, PSNR, CUBOID, XERR), "harmonizer-temporal", ("harmonizer",), "not better"),
        ),
    ),
    Claim(
        4, "OmniDreams at 4 steps is better than at 1 on LPIPS, FVD and FVMD, and worse on Warp L1 over 900 frames", "Table 1",
        (
            *each("cycle", (PERCEPTUAL, FD, MOTION), "omnidreams@4", ("omnidreams@1",)),
            *each("under-trained", (PERCEPTUAL, FD, MOTION), "omnidreams@4", ("omnidreams@1",)),
            Comparison("under-trained", WARP, "omnidreams@1", "omnidreams@4"),
        ),
    ),
    Claim(
        5, "Distillation improves ArtiFixer at one step (FVD 13.3 to 8.46); before it, four steps stay better (6.88)", "Table 1, Waymo",
        (Comparison("cycle", FD, "artifixer", "artifixer-pre@1"), Comparison("cycle", FD, "artifixer-pre@4", "artifixer")),
    ),
    Claim(
        6, "Own history (V2) moves better than clean history (V1) but stays perceptually worse; LPIPS alone (V3) is as close but moves "
        "worse; V9 is the best balance", "Table 2a",
        (
            Comparison("cycle", MOTION, "V2", "V1"),
            Comparison("cycle", PERCEPTUAL, "V3", "V2"),
            Comparison("cycle", MOTION, OURS, "V3"),
            *each("cycle", (FD,), OURS, ("V1", "V2", "V3")),
        ),
    ),
    Claim(
        7, "From noise (V6) collapses; re-denoised history (V8) has the worst LPIPS of the joint variants; two stages (V7) and k = 1 (V4) "
        "have worse FVD and FVMD", "Table 2a",
        (
            *each("cycle", (FD, PERCEPTUAL), "3dgs", ("V6",)),
            *(Comparison("cycle", PERCEPTUAL, joint, "V8") for joint in ("V4", "V5", OURS)),
            *each("cycle", (FD, MOTION), OURS, ("V7", "V4")),
            Comparison("cycle", PERCEPTUAL, OURS, "V4", "close"),
        ),
    ),
    Claim(
        8, "Without a map (V5) it still beats every one-step baseline on FVD, LPIPS and Cuboid F1", "Tables 2a and 1",
        each("cycle", (FD, PERCEPTUAL, CUBOID), "V5", ONE_STEP),
    ),
    Claim(
        9, "In closed loop DiFix collides more than the raw render and leaves the road less; arms of the same backbone stay near the raw "
        "render", "Table 2b",
        (
            *(Comparison(behind(policy), "collision_at_fault", "3dgs", "difix") for policy in DRIVERS),
            *(Comparison(behind(policy), "offroad", "difix", "3dgs") for policy in DRIVERS),
            *(
                Comparison(behind(policy), "collision_at_fault", arm, "3dgs", "close")
                for policy in DRIVERS for arm in ("omnidreams@4", "self-forcing")
            ),
        ),
    ),
    Claim(
        10, "Over 900 frames distilled arms are close to OmniDreams at one step", "Table 1, Seoul",
        tuple(comparison for arm in DISTILLED for comparison in each("under-trained", (PERCEPTUAL, PSNR), arm, ("omnidreams@1",), "close")),
    ),
    Claim(
        11, "OneFixer takes far less time a frame than video fixers; with a shifted map its lanes and vehicles stay better than with none; "
        "in half of the distilled arms' training time its FVD is below their final one, and their FVMD is no better",
        "latency, robustness and GPU-hour figures",
        (
            *each("cycle", (MS,), OURS, ("3dgs-enhancer@8", "omnidreams@4", "artifixer-pre@4")),
            *each("map-error", (LANE,), "V9, lanes 0.50 m aside", ("V5",)),
            *each("map-error", (CUBOID,), "V9, boxes 0.35 m aside", ("V5",)),
            *(Comparison("cost", FD_16, within(arm), arm) for arm in DISTILLED),
            *(Comparison("cost", MOTION, arm, within(arm), "not better") for arm in DISTILLED),
        ),
    ),
    Claim(
        12, "A temporal Harmonizer that was trained on clean frames drifts on its own outputs; one trained on its own outputs does not",
        "drift figure",
        (Comparison("cycle", DRIFT, "harmonizer-temporal", "harmonizer-temporal-teacher"),),
    ),
    Claim(
        13, "Beyond driving and after fine-tuning OneFixer is best on PSNR, LPIPS in the middle and at the end, and FVMD; ArtiFixer is "
        "best on Warp L1", "DL3DV table",
        (
            *each("transfer", (PSNR, MID, LAST, MOTION), OURS, ("difix", "artifixer")),
            *each("transfer", (WARP,), "artifixer", ("difix", OURS)),
        ),
    ),
    Claim(
        14, "Asked for night, fog or snow, OneFixer renders the style and keeps lanes better than editing systems; here: the style in nine "
        "frames of ten, lanes not below the raw render's by the formula (editing systems cannot be run here)", "appearance table",
        (
            *(Comparison("appearance", metric, "appearance", "0.9", bound=0.9) for metric in (STYLE_ACC, of_seed(STYLE_ACC, 1))),
            *(Comparison("appearance", metric, "3dgs + formula", "appearance", "not better") for metric in (LANE, of_seed(LANE, 1))),
        ),
    ),
)  # fmt: skip
