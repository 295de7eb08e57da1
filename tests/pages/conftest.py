import pytest

from tests.pages.make_run import Plan, make_run
from tests.pages.make_watched import make_watched

HOSTILE = "<img src=x onerror=alert(1)>\"'&|{{7*7}}"


@pytest.fixture(scope="session")
def usual_run(tmp_path_factory):
    """Make three renderers x two policies x four scenes x three seeds, two failures, one metric
    invalid in one scene.
    """
    fail = [("3dgs", "urban/left-turn", 1), ("onefixer", "USA_US101-3_3_T-1", 2)]
    return make_run(
        tmp_path_factory.mktemp("usual"),
        Plan(policies=("lane-camera", "pure-pursuit"), fail=fail, flip_frames=True),
    )


@pytest.fixture(scope="session")
def hostile_run(tmp_path_factory):
    """Make a run whose every name is markup."""
    plan = Plan(
        renderers=("clean", f"nre://{HOSTILE}:50051"),
        policies=("javascript:alert(1)",),
        scenes=(HOSTILE, "../../etc/passwd", "x" * 200, "plain"),
        seeds=(0, 2**40),
        steps=30,
        fail=[("clean", HOSTILE, 0)],
        failure=f"</script><script>alert(1)</script>\n{HOSTILE}\x00\x1b[31m",
    )
    return make_run(tmp_path_factory.mktemp("hostile"), plan)


@pytest.fixture(scope="session")
def watched_run(tmp_path_factory):
    """Make three renderers x two scenes x two seeds with logs, of which some end differently."""
    return make_watched(tmp_path_factory.mktemp("watched"))
