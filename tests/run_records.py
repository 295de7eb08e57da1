"""Records of a run folder, made of what a test states of them."""

import json

from alpasim_plugin.core.files import read_record
from alpasim_plugin.log.run_folder.records import Manifest, RunInfo

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


def manifest(members):
    """Make ``manifest.json`` of its members as JSON has them; metrics may be stated without unit and
    direction, an error in part, and the key is that of one rollout.
    """
    usual = {
        "renderer": "clean",
        "policy": "p",
        "scene": "s",
        "seed": 0,
        "path": "rollouts/clean/p/s/0",
        "status": "ok",
        "wall_s": 1.0,
    }
    content = {**usual, **members}
    content["metrics"] = {
        name: {"unit": "", "direction": "lower", **entry}
        for name, entry in members.get("metrics", {}).items()
    }
    if members.get("error") is not None:
        content["error"] = {"message": "", "hint": "", "failure_class": "", **members["error"]}
    events = members.get("events", ())
    content["events"] = [{"t_us": 0, "t_s": 0.0, "x_m": 0.0, "y_m": 0.0, **one} for one in events]
    return read_record(Manifest, json.dumps(content).encode(), "manifest.json")
