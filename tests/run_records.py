"""Records of a run folder, made of what a test states of them."""

import json

from alpasim_plugin.core.files import read_record
from alpasim_plugin.log.run_folder.records import RunInfo

CONFIG = {
    "preset": "paper",
    "images": "jpeg",
    "video": "none",
    "device": "cpu",
    "baseline": None,
    "fixer": [],
    "controller": None,
    "evaluators": [],
    "workers": 2,
    "threads_per_worker": 1,
}
MINIMAL = {
    "key": "key",
    "command": ["simrun"],
    "preset": "paper",
    "renderers": ["clean"],
    "policies": ["constant-velocity"],
    "seeds": [0],
    "scenes": {},
}
PART = {
    "target": "module:Part",
    "label": "part",
    "digest": None,
    "trained": None,
    "files": {},
    "code": {},
    "unseen": "",
    "settings": None,
}


def run_info(members):
    """Make ``run.json`` of its members as JSON has them; a configuration, and parts, may be stated in
    part.
    """
    config = {**CONFIG, **members.get("config", {})}
    if members.get("kind") == "score":
        config = members["config"]
    parts = {
        block: {name: {**PART, **facts} for name, facts in members.get(block, {}).items()}
        for block in ("parts", "fixers")
    }
    content = {**members, "config": config, **parts}
    return read_record(RunInfo, json.dumps(content).encode(), "run.json")
