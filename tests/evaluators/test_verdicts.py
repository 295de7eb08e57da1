"""The three-way verdict, its companions, and cells without a pair."""

import numpy as np
import pytest
from scipy import stats

from alpasim_plugin.log.run_folder.sides import by_renderer
from evaluators import METRICS, paired
from evaluators.results import Beyond, CellCounts, SceneCounts
from evaluators.statistics.differences import difference_bounds
from evaluators.statistics.paired import compare
from evaluators.statistics.sentences import difference_text
from evaluators.statistics.verdicts import holm, sign_flip, verdict
from tests.evaluators.rollout_rows import rows_of


def pair(base, other, metric="route_distance_m", margin=None):
    side = by_renderer(rows_of(other, metric))["3dgs"]
    base_side = by_renderer(rows_of(base, metric))["3dgs"]
    return compare(side, base_side, METRICS.info(metric), "clean", margin)


@pytest.mark.parametrize(
    ("bounds", "wanted"),
    [
        ([-0.3, -0.1], "non-inferior"),
        ([-0.1, 0.19], "non-inferior"),
        ([0.05, 0.19], "non-inferior"),  # worse than 0, and within the margin
        ([-0.1, 0.2], "undecided"),
        ([0.05, 0.3], "undecided"),
        ([0.2, 0.3], "undecided"),  # touches the margin
        ([0.21, 0.3], "worse"),
        (None, "undecided"),
    ],
)
def test_the_margin_divides_the_verdicts(bounds, wanted):
    assert verdict(bounds, 0.001, 0.2, "lower") == wanted
    mirrored = None if bounds is None else [-bounds[1], -bounds[0]]
    assert verdict(mirrored, 0.001, 0.2, "higher") == wanted


def test_worse_also_needs_the_test_to_reject():
    assert verdict([0.21, 0.3], 0.0625, 0.2, "lower") == "undecided"


def test_a_metric_without_a_better_side_is_worse_on_either_side_of_its_margin():
    for sign in (1, -1):
        bounds = sorted([sign * 0.3, sign * 0.5])
        assert verdict(bounds, 0.001, 0.2, "none") == "worse"
        assert verdict(bounds, 0.001, 0.6, "none") == "non-inferior"
        assert verdict(bounds, 0.001, 0.4, "none") == "undecided"
        assert verdict(bounds, 0.001, 0.0, "none") == "undecided"


def test_margins_are_given_or_the_documented_defaults():
    base = [[float(i)] for i in range(8)]
    other = [[i + 0.3 + 0.01 * (i % 3)] for i in range(8)]
    assert pair(base, other).margin == 0.1
    assert pair(base, other, margin=0.2).margin == 0.2
    assert pair([[0.0]] * 3, [[0.0]] * 3, "offroad").margin == 0.02
    many = [[float(i)] for i in range(400)]
    assert (
        pair(
            many,
            [[v[0] + 0.3 + 0.01 * (v[0] % 3)] for v in many],
            margin=0.5,
        ).verdict
        == "non-inferior"
    )


def test_an_undecided_difference_says_how_many_more_scenes_would_decide_it():
    rng = np.random.Generator(np.random.Philox(2))
    base = rng.normal(1.0, 0.5, (8, 1))
    found = pair(base.tolist(), (base + rng.normal(0.3, 0.5, (8, 1))).tolist())
    assert found.verdict == "undecided"
    assert (found.claim, found.cut_mean) == ("mean cut at 4 m", pytest.approx(found.diff))
    assert found.spread == pytest.approx(0.5, rel=0.6)
    assert 5 < found.more_scenes < 2000
    assert (
        pair([[1.0], [2.0]], [[1.0], [2.0]]).more_scenes == 146 - 2
    )  # as many as show that nothing was missed


def test_the_scenes_that_show_a_difference_are_counted_for_so_many_tests_as_are_read_together():
    """One of three scenes has the event: 24 scenes reject by themselves, 29 with Holm for two."""

    def variant(name, values):
        return rows_of([[value] for value in values], METRICS.primary, name)

    base = variant("clean", (0.0, 0.0, 0.0))
    worse = variant("3dgs", (1.0, 0.0, 0.0))
    alone = paired([*base, *worse], "clean")["3dgs"][METRICS.primary]
    assert (alone.more_scenes, alone.more_scenes_to_differ) == (27 - 3, 24 - 3)
    both = paired([*base, *worse, *variant("onefixer", (0.0, 0.0, 0.0))], "clean")
    entry = both["3dgs"][METRICS.primary]
    assert (entry.more_scenes, entry.more_scenes_to_differ) == (29 - 3, 29 - 3)
    alike = both["onefixer"][METRICS.primary]
    assert (alike.more_scenes, alike.more_scenes_to_differ) == (183 - 3, None)


def test_rare_events_alone_never_decide_on_few_scenes():
    found = pair([[0.0, 0.0]] * 20, [[0.0, 0.0]] * 20, "offroad")
    bound = 1 - 0.025 ** (1 / 20)
    assert found.ci95 == pytest.approx([-bound, bound])
    assert (found.verdict, found.more_scenes) == ("undecided", 183 - 20)  # margin of 2 points
    assert pair([[0.0]] * 200, [[0.0]] * 200, "offroad").verdict == "non-inferior"


def test_scenes_that_cannot_have_shown_a_rare_harm_decide_nothing_however_alike_they_are():
    rng = np.random.Generator(np.random.Philox(3))
    for n, wanted in ((20, "undecided"), (140, "undecided"), (400, "non-inferior")):
        base = rng.normal(1.0, 0.5, (n, 1))
        found = pair(base.tolist(), (base + rng.normal(0.0, 0.02, (n, 1))).tolist())
        assert found.verdict == wanted, n
        assert found.ci95 == found.guarded, "no scene lies beyond the cap"
        assert found.guarded[1] == pytest.approx(4.0 * (1 - 0.025 ** (1 / n)), abs=0.03)
    few = pair([[1.0]] * 20, [[1.001], [0.999]] * 10)
    assert few.note == "20 scenes cannot exclude that a few others are worse by up to 4 m"
    assert few.more_scenes == 146 - 20


def test_equal_scenes_have_no_spread_to_go_by():
    for equal in (0.0, 0.1 + 0.2, 1e-9):
        found = pair([[1.0 + i] for i in range(8)], [[1.0 + i + equal] for i in range(8)])
        assert found.verdict == "undecided"
        assert found.difference == ("worse" if equal else None)
        assert found.ci95 == found.guarded
        assert found.ci95[1] > 1.0
        assert "8 scenes are equal" in found.note
    two = pair([[1.0], [1.0]], [[1.0], [1.0]])
    assert (two.verdict, two.difference) == ("undecided", None)
    assert two.note.endswith("2 scenes: a verdict needs at least 6")


def test_values_at_the_end_of_the_numbers_decide_nothing():
    huge = pair([[0.0]] * 8, [[0.5e308 * (i % 4)] for i in range(8)])
    assert huge.diff == pytest.approx(0.75e308)
    assert np.isfinite([*huge.ci95, *huge.guarded, huge.p_value]).all()
    beyond = pair([[-1e308]] * 8, [[1e308]] * 8)
    assert (beyond.verdict, beyond.ci95) == ("undecided", None)
    assert "too large" in beyond.reason


def test_mcnemar_counts_cells_and_the_sign_test_scenes():
    base = [[0.0, 0.0, 1.0]] * 4 + [[0.0, 0.0, 0.0]] * 4
    other = [[1.0, 1.0, 0.0]] * 4 + [[0.0, 0.0, 0.0]] * 4
    found = pair(base, other, "collision_any")
    assert found.cells == CellCounts(8, 4, pytest.approx(stats.binomtest(8, 12).pvalue))
    assert found.scenes == SceneCounts(4, 0, 4, pytest.approx(2 * 0.5**4))
    assert found.p_value == found.scenes.p_value


def test_every_cell_without_a_pair_is_named_with_its_side_and_cause():
    base = rows_of([[1.0, 1.0], [2.0, None]], renderer="clean")
    other = rows_of([[1.5, 1.5], [2.5, None]])[:3] + rows_of([[0.0]])[:0]
    other[1] |= {"status": "failed", "failure_class": "renderer"}
    found = paired(base + other, "clean")["3dgs"]["route_distance_m"]
    assert (found.n_cells, found.n_missing) == (2, 2)
    first, second = found.missing
    assert (first.scene, first.seed, first.missing, first.why) == (
        "scene-0",
        1,
        "here",
        "here: failed (renderer)",
    )
    assert (second.scene, second.seed, second.missing) == ("scene-1", 1, "both")
    assert second.why == "here: not planned; baseline: not valid (not given)"
    assert paired(base + other, "clean", listed=1)["3dgs"]["route_distance_m"].n_missing == 2


def test_a_rate_is_worse_only_by_what_also_holds_for_scenes_that_were_not_drawn():
    def gained(k):
        return pair([[0.0]] * 20, [[1.0]] * k + [[0.0]] * (20 - k), "offroad", margin=0.05)

    assert [gained(k).verdict for k in (6, 7)] == ["undecided", "worse"]
    assert gained(6).ci95[0] > 0.05 > gained(6).guarded[0]


def test_metres_are_worse_or_better_only_where_few_other_scenes_could_not_undo_it():
    def moved(by, n=20, **options):
        base = [[50.0 + i] for i in range(n)]
        other = [[50.0 + i + by + 0.01 * (i % 3)] for i in range(n)]
        found = pair(base, other, "lateral_distance_m", **options)
        return found.verdict, found.difference, found.note or ""

    few = "20 scenes cannot exclude that a few others are {} by up to 4 m"
    assert moved(0.3) == ("undecided", "worse", few.format("better"))
    assert moved(-0.3) == ("undecided", "better", few.format("worse"))
    assert moved(2.0) == ("worse", "worse", "")
    assert moved(-0.3, 60)[:2] == ("non-inferior", "better")
    assert moved(-2.0)[:2] == ("non-inferior", "better")
    assert moved(0.3, 100)[:2] == ("worse", "worse")


def test_a_metric_of_which_nothing_says_how_much_a_scene_can_differ_decides_nothing_without_a_margin():
    base = [[float(i)] for i in range(20)]
    other = [[i + 5.0 + 0.01 * (i % 3)] for i in range(20)]
    found = pair(base, other, "contact_x_m")
    assert (found.verdict, found.guarded, found.ci95) == ("undecided", None, None)
    assert (found.claim, found.cut_mean, found.beyond) == (None, None, None)
    assert "nothing says how much a scene" in found.reason
    assert found.difference is None, "it has no better side"
    assert pair(base, other, "contact_x_m", margin=0.1).claim == "mean cut at 4 m"


def test_the_correction_is_holms():
    assert holm([0.01, None, 0.04, 0.03]) == pytest.approx([0.03, None, 0.06, 0.06])
    assert holm([None]) == [None]


def test_what_differs_on_these_scenes_is_shown_by_their_signs_whatever_others_may_do():
    """Sixty scenes, each 0.2 m worse, are a difference; 1e-15 m of rounding is none."""
    rng = np.random.Generator(np.random.Philox(5))
    base = rng.uniform(1.0, 3.0, (60, 1))
    found = pair(base.tolist(), (base + 0.2 + rng.normal(0, 0.05, (60, 1))).tolist())
    assert (found.difference, found.verdict) == ("worse", "undecided")
    assert found.p_value == 1e-4  # one of 9,999 draws and the one seen
    rounded = pair([[0.3, 0.1]] * 60, [[0.1 + 0.2, 0.1]] * 60)
    assert rounded.scenes == SceneCounts(up=0, down=0, same=60, p_value=1.0)
    assert rounded.p_value == 1.0


@pytest.mark.parametrize("scenes", [7, 60])
def test_variants_that_are_alike_differ_in_one_run_of_twenty_whatever_their_tails(scenes):
    rng = np.random.Generator(np.random.Philox(scenes))
    draws = [rng.standard_cauchy(scenes) for _ in range(300)]
    draws += [rng.integers(-1, 2, scenes) * (rng.random(scenes) < 0.5) for _ in range(300)]
    assert np.mean([sign_flip(np.asarray(x, dtype=float))[0] <= 0.05 for x in draws]) <= 0.075


def test_few_flips_are_counted_and_many_are_drawn_with_almost_the_same_answer():
    x = np.random.Generator(np.random.Philox(8)).normal(0.4, 1.0, 16)
    signs = 1 - 2 * (np.arange(2**16)[:, None] >> np.arange(16) & 1)
    whole = np.mean(np.abs(signs @ x) >= abs(x.sum()) - 1e-9)
    assert sign_flip(x)[0] == pytest.approx(whole, abs=0.01)
    ten = sign_flip(x[:10])[0]
    assert ten == np.mean(np.abs((signs[:1024, :10]) @ x[:10]) >= abs(x[:10].sum()) - 1e-9)


def guarded_verdict(harms, metric="lateral_distance_m", margin=0.1):
    """Return the verdict on scenes of one seed by the claim's bounds, if the test rejects."""
    facts = METRICS.info(metric)
    _, guarded = difference_bounds(harms, harms, np.arange(len(harms)), facts, margin)
    return verdict(guarded, 0.0, margin, "lower")


def test_a_claim_about_a_distance_is_about_the_mean_cut_at_its_cap_and_counts_what_lies_beyond():
    """One scene of 150 leaves the route by 40 m: the mean is 0.27 m worse, the cut mean 0.027."""
    base = [[1.0]] * 150
    far = pair(base, [[41.0]] + [[1.0]] * 149, "lateral_distance_m", margin=0.2)
    assert (far.verdict, far.claim) == ("non-inferior", "mean cut at 4 m")
    assert far.diff == pytest.approx(40 / 150)
    assert far.cut_mean == pytest.approx(4 / 150)
    assert far.guarded[1] < 0.2 < far.diff < far.ci95[1], "the interval holds the mean not cut"
    assert far.beyond == Beyond(
        "worse by more than 4 m", 1, 150, pytest.approx(stats.beta.ppf(0.95, 2, 149))
    )
    text = difference_text(far, METRICS.info("lateral_distance_m")).replace("\u00a0", " ")
    assert "the verdict is about the mean cut at 4 m, +0.0267 m, left_route about what" in text
    assert "1 of 150 scenes worse by more than 4 m, of others at most 3.1 %" in text
    either = pair(base, [[-40.0]] + [[1.0]] * 149, "lateral_bias_m")
    assert (either.beyond.event, either.beyond.n) == ("different by more than 4 m", 1)
    better = pair([[41.0]] + [[1.0]] * 149, base, "lateral_distance_m")
    assert better.beyond.n == 0
    rate = pair([[0.0]] * 20, [[0.0]] * 20, "offroad")
    assert (rate.claim, rate.cut_mean, rate.beyond) == ("mean", 0.0, None)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("share", "far_m", "usual_m"),
    [(0.026, 20.0, 0.0), (0.026, 4.0, 0.0), (0.03, 15.0, -0.015), (0.5, 0.2, 0.0)],
)
def test_no_answer_about_a_cut_mean_on_its_margin_is_given_more_often_than_is_promised(
    share, far_m, usual_m, sign
):
    """Rare harms far beyond the cap, and gains that bring the mean back to the margin."""
    margin = 0.1
    wrong_answer = "non-inferior" if sign > 0.0 else "worse"
    wrong = 0
    for number in range(40):
        rng = np.random.Generator(np.random.Philox([number, int(1000 * share)]))
        harms = np.where(rng.random(200) < share, far_m, usual_m)
        mirrored = harms if sign > 0.0 else 2.0 * margin - harms
        wrong += guarded_verdict(mirrored) == wrong_answer
    assert wrong <= 3


@pytest.mark.parametrize("rate", [0.3, 0.5])
@pytest.mark.parametrize("n", [12, 20])
def test_gained_and_lost_events_exclude_each_other_and_the_interval_of_their_difference_covers(
    rate, n
):
    """Exact: without their covariance the coverage is 84 to 94 % here."""
    covered = 0.0
    for new in range(n + 1):
        for gone in range(n + 1 - new):
            chance = stats.multinomial.pmf(
                [new, gone, n - new - gone], n, [rate, rate, 1 - 2 * rate]
            )
            if chance > 1e-5:
                side = pair(
                    [[0.0]] * new + [[1.0]] * gone + [[0.0]] * (n - new - gone),
                    [[1.0]] * new + [[0.0]] * (n - new),
                    "offroad",
                )
                covered += chance * (side.ci95[0] <= 0.0 <= side.ci95[1])
    assert covered >= 0.95
