"""What the scores of other benchmarks and their parts are, as metrics; the rules are in
`evaluators.metrics.protocols`.
"""

from alpasim_plugin.core.metric_types import MetricInfo

_FAULT = "no contact at fault; one with an object costs a half"
_AGAINST = "less than 2 m against the traffic within 1 s; up to 6 m costs a half"
_TTC = "time to collision always more than 0.95 s"
_COMFORT = "accelerations, jerks and turning within nuPlan's bounds"
SCORES = {  # benchmark -> score -> what it says
    "nuplan": {"score": "nuPlan's closed-loop score"},
    "navsim": {"pdms": "NAVSIM's PDM score", "epdms": "NAVSIM 2's extended PDM score"},
}
PARTS = {  # benchmark -> part -> what it says: a share, the higher the better
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
        "lk": "never more than 0.5 m from the middle of the lane for 2 s",
        "hc": _COMFORT,
        "ec": "share of plans that move as the one 0.5 s before meant to",
    },
}
ENDS = {  # ending of a score's name -> what it adds, and where it has no value
    "": ("", "a part is not measured that would decide"),
    "_least": ("; nothing for what is not measured", "never"),
    "_most": ("; full marks for what is not measured", "never"),
}
NOT_MEASURED = "[what it reads is not there](metrics.md#other-benchmarks)"


def _share(text: str, invalid: str) -> MetricInfo:
    return MetricInfo("", "higher", "last", text, limits=(0.0, 1.0), invalid=invalid)


def _metrics(benchmark: str) -> dict[str, MetricInfo]:
    scores = {
        f"{benchmark}_{name}{end}": _share(text + more, invalid)
        for name, text in SCORES[benchmark].items()
        for end, (more, invalid) in ENDS.items()
    }
    parts = PARTS[benchmark].items()
    return scores | {f"{benchmark}_{name}": _share(text, NOT_MEASURED) for name, text in parts}


BENCHMARKS = {name: facts for benchmark in SCORES for name, facts in _metrics(benchmark).items()}
