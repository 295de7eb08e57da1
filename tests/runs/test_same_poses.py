"""A run with several renderers keeps what each of them shows before a failure."""

from alpasim_plugin.core.files import read_json
from alpasim_plugin.log.run_folder.manifests import read_manifest
from alpasim_plugin.log.run_folder.schema import SAME_POSES
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.run import execute_run
from evaluators.metrics.outcomes import first_failure
from scenarios.suite import expand
from tests.runs.grey_policy import BY_GREY
from tests.runs.grey_renderer import GREY
from tests.runs.short_runs import Announced

DARKER = "tests.runs.grey_renderer:Darker"


def test_images_of_the_other_renderer_are_stored_beside_a_failure(tmp_path):
    """The darker images steer the policy off the road."""
    refs = expand("smoke/straight", ("timing.duration_us=4000000",))
    plan = make_plan(refs, (GREY, DARKER), (BY_GREY,), (0,), RunOptions())
    root = tmp_path / "run"
    announced = Announced()
    execute_run(plan, root, 1, ["simrun"], announced, report=False)
    manifests = [read_manifest(root / cell.folder) for cell in plan.cells]
    errors = [manifest.error for manifest in manifests]
    assert errors == [None, None], announced.notices
    is_failure = [first_failure(manifest.events) is not None for manifest in manifests]
    assert is_failure == [False, True], [manifest.events for manifest in manifests]
    (file,) = root.glob(f"rollouts/**/{SAME_POSES}")
    assert file.parent == root / plan.cells[1].folder
    content = read_json(file)
    assert content["key"]
    assert [*content["images"]] == [GREY]
    assert len(content["images"][GREY]) > 0
