import xml.etree.ElementTree as ET
from dataclasses import replace

from evaluators.pages.ci import rollout_suite, write_junit
from evaluators.statistics.opening import read_run


def test_one_case_per_rollout_and_an_error_per_failure(usual_run):
    suite = ET.parse(write_junit(read_run(usual_run))).getroot().find("testsuite")
    cases = suite.findall("testcase")
    assert len(cases) == int(suite.attrib["tests"]) == 72
    assert len({(c.attrib["classname"], c.attrib["name"]) for c in cases}) == 72
    assert sum(c.find("error") is not None for c in cases) == int(suite.attrib["errors"]) == 4
    assert sum(c.find("failure") is not None for c in cases) == int(suite.attrib["failures"]) > 0
    case = next(
        c
        for c in cases
        if (c.attrib["classname"], c.attrib["name"]) == ("urban/left-turn", "3dgs/lane-camera/1")
    )
    error = case.find("error")
    assert error.attrib["type"] == "renderer"
    assert error.attrib["message"] == "1204 NaN pixels <b>&"


def test_metric_values_are_properties_and_invalid_ones_say_so(usual_run):
    root = ET.parse(write_junit(read_run(usual_run))).getroot()
    case = next(
        c
        for c in root.iter("testcase")
        if c.attrib["classname"] == "smoke/straight" and c.find("error") is None
    )
    values = {p.attrib["name"]: p.attrib["value"] for p in case.iter("property")}
    assert values["min_distance_to_obstacle_m"] == "invalid"
    assert float(values["lateral_distance_m"]) > 0
    assert values["path"].startswith("rollouts/")


def test_an_outcome_is_a_failed_case_of_the_run_and_a_property_of_the_case_in_a_gate(usual_run):
    for is_gate in (False, True):
        cases = rollout_suite(read_run(usual_run), outcomes_fail=not is_gate).cases
        hits = [case for case in cases if case.facts.get("collision_any") == 1.0]
        assert hits
        for case in hits:
            assert case.result == ("pass" if is_gate else "failure")
            assert is_gate or "at-fault collision" in case.message
            assert case.facts["outcome"].startswith("at-fault collision")


def test_hostile_names_and_control_characters_give_readable_xml(hostile_run):
    root = ET.parse(write_junit(read_run(hostile_run))).getroot()
    error = next(root.iter("error"))
    assert error.attrib["message"] == "</script><script>alert(1)</script>"
    assert "\\x00\\x1b[31m" in (error.text or "")


def test_two_logs_of_one_cell_are_two_cases(usual_run):
    run = read_run(usual_run)
    first = run.rollouts[0]
    twice = [replace(first, log=name) for name in ("log 1", "log 2")]
    names = [case.name for case in rollout_suite(replace(run, rollouts=twice)).cases]
    assert names == [f"{first.renderer}/{first.policy}/{first.seed} {one.log}" for one in twice]
    (case,) = rollout_suite(replace(run, rollouts=twice[:1])).cases
    assert case.name == f"{first.renderer}/{first.policy}/{first.seed}"
