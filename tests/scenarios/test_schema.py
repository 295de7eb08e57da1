"""The committed JSON Schema and the documented keys are those of the code."""

import json
import re

from scenarios.load import load_scenario
from scenarios.schema import SCHEMA_FILE, json_schema


def test_committed_schema_is_current():
    assert SCHEMA_FILE.read_text(encoding="utf-8") == json_schema(), (
        "run python -m scenarios.schema"
    )


def test_schema_is_closed_and_versioned():
    schema = json.loads(json_schema())
    assert schema["properties"]["version"]["const"] == 1
    assert schema["additionalProperties"] is False
    assert all(
        d.get("additionalProperties") is False
        for name, d in schema["$defs"].items()
        if d.get("type") == "object"
    )


def test_examples_in_the_docs_load(repo, tmp_path):
    text = (repo / "docs" / "scenarios.md").read_text(encoding="utf-8")
    examples = [
        block
        for block in re.findall(r"```yaml\n(.*?)```", text, re.S)
        if "version: 1" in block and "road:" in block
    ]
    assert examples
    for i, block in enumerate(examples):
        path = tmp_path / f"example{i}.yaml"
        path.write_text(block)
        assert load_scenario(path).lane_map.lanes
