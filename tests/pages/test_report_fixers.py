"""What a report says of fixers: untrained ones, refused frames, hit rates."""

from dataclasses import replace

from evaluators.pages.fixers import fixer_cautions
from evaluators.results import FixerFacts
from evaluators.statistics.opening import NO_SUMMARY
from evaluators.statistics.summary import joined_censoring

NOTHING = joined_censoring([])
DRAFTED = FixerFacts(
    label="onefixer-tiny, untrained (identity)",
    trained=False,
    mode="speculative",
    rollouts=1,
    frames=70,
    blocks=9,
    hit_rate=0.75,
    redrafts=18,
    shown_error={"camera_m": 0.019},
)
BLOCKS = FixerFacts(
    label="onefixer-s, trained", trained=True, mode="chunk", rollouts=1, frames=69, blocks=9
)
SUMMARY = replace(
    NO_SUMMARY,
    fixers={"onefixer": DRAFTED, "onefixer-s": BLOCKS},
    censoring={
        "onefixer-s": replace(NOTHING, frame_events={"fixer-nan": 3, "fixer-black": 1, "black": 7}),
        "onefixer": NOTHING,
    },
)


def test_untrained_weights_and_refused_frames_are_cautions():
    untrained, refused = fixer_cautions(SUMMARY)
    assert (
        untrained
        == "onefixer is onefixer-tiny, untrained (identity): its results say nothing about a trained fixer."
    )
    assert refused.replace("\u00a0", " ") == (
        "onefixer-s: the fixer failed on 4 frames of 69 (black 1, nan 3); the raw frames were passed on."
    )


def test_a_frame_that_the_render_itself_had_black_is_not_the_fixers_failure():
    only_black = replace(
        NO_SUMMARY,
        fixers={"f": BLOCKS},
        censoring={"f": replace(NOTHING, frame_events={"black": 7})},
    )
    assert fixer_cautions(only_black) == []
