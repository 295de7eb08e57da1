"""What the scores of other benchmarks and their parts are, as metrics; the rules are in
`evaluators.scores.protocols`.
"""

from __future__ import annotations

from alpasim_plugin.core.metric_types import MetricInfo

_FAULT = "no contact at fault; one with an object costs a half"
_AGAINST = "less than 2 m against the traffic within 1 s; up to 6 m costs a half"
_TTC, _COMFORT = (
    "time to collision always more than 0.95 s",
    "accelerations, jerks and turning within nuPlan's bounds",
)
SCORES = {  # benchmark -> score -> what it says
    "nuplan": {"score": "nuPlan's closed-loop score"},
    "navsim": {"pdms": "NAVSIM's PDM score", "epdms": "NAVSIM 2's extended PDM score"},
    "hugsim": {"hd_score": "HUGSIM's HD-Score"},
    "ncap": {"score": "NeuroNCAP's score, of 5"},
}
MOST = {"ncap": 5.0}  # where full marks are not 1
# benchmark -> part -> what it says: a share, the higher the better, unless its name ends with a
# unit
PARTS = {
    "nuplan": {
        "no_at_fault_collision": _FAULT,
        "drivable_area": "never more than 0.3 m off the drivable surface",
        "making_progress": "a fifth of the recording's progress or more",
        "driving_direction": _AGAINST,
        "progress": "progress as a share of the recording's",
        "time_to_collision": _TTC,
        "speed_limit": "1, less the mean overspeed as a share of 2.23 m/s",
        "comfort": _COMFORT,
    },
    "navsim": {
        "nc": _FAULT,
        "dac": "never off the drivable surface",
        "ddc": _AGAINST,
        "tlc": "no red light is passed",
        "ep": "progress as a share of the greater of the ego's and the recording's, for PDM-Closed's",
        "ttc": _TTC,
        "lk": "never more than 0.5 m beside the middle of the lane for 2 s",
        "hc": _COMFORT,
        "ec": "share of plans that move as the one 0.5 s before meant to",
    },
    "hugsim": {
        "nc": "share of plans that touch nobody",
        "dac": "share of plans that stay on the drivable surface",
        "ttc": f"share of plans: {_TTC}",
        "com": f"share of plans: {_COMFORT}",
        "hd": "mean over plans of nc x dac x (5 ttc + 2 com) / 7",
        "rc": "share of the recorded path that was reached",
    },
    "ncap": {
        "points": "5 without a contact, else 4 x (1 - impact speed / that of a drive that does nothing)",
        "impact_mps": "relative speed at the first contact",
        "passive_impact_mps": "the same of a drive that goes on as it was at the handover",
    },
}


def _of(benchmark: str) -> dict[str, MetricInfo]:
    limits, out = (0.0, MOST.get(benchmark, 1.0)), {}
    for name, text in SCORES[benchmark].items():
        for end, which in (
            ("", ""),
            ("_least", "; nothing for what is not measured"),
            ("_most", "; full marks for what is not measured"),
        ):
            unknown = "never" if end else "a part is not measured that would decide"
            out[f"{benchmark}_{name}{end}"] = MetricInfo(
                "", "higher", "last", text + which, limits=limits, invalid=unknown
            )
    for name, text in PARTS[benchmark].items():
        if name.endswith("_mps"):
            out[f"{benchmark}_{name}"] = MetricInfo(
                "m/s", "lower", "last", text, limits=(0.0, None), invalid="no contact"
            )
        else:
            unknown = "[what it reads is not there](presets.md#other-benchmarks)"
            out[f"{benchmark}_{name}"] = MetricInfo(
                "", "higher", "last", text, limits=limits, invalid=unknown
            )
    return out


BENCHMARKS = {name: facts for benchmark in SCORES for name, facts in _of(benchmark).items()}
