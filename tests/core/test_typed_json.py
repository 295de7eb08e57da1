"""Values come back from JSON as they were, and no two of them look the same."""

import json
import math
from enum import Enum

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from alpasim_plugin.core.files import read_record
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.files.inputs import Inputs
from alpasim_plugin.core.parts.spec import part_digest
from alpasim_plugin.core.typed_json import from_plain, to_plain
from alpasim_plugin.log.run_folder.records import PartFacts, json_of

names = st.one_of(st.text(max_size=5), st.sampled_from(["!float", "!", "!set", "inf", "nan"]))
scalars = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), names, st.binary(max_size=3)
)
keys = st.one_of(names, st.integers(), st.floats(allow_nan=False))
values = st.recursive(
    scalars,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(keys, inner, max_size=3),
        st.sets(st.one_of(names, st.integers()), max_size=3),
    ),
    max_leaves=8,
)


def described(value):
    """Return the types and values in a value, whatever the order of sets and mappings: nan is nan."""
    if isinstance(value, dict):
        return f"dict{sorted((described(key), described(value[key])) for key in value)}"
    if isinstance(value, set):
        return f"set{sorted(map(described, value))}"
    if isinstance(value, list):
        return f"list{[described(member) for member in value]}"
    return repr(value)


def stored(value):
    """Write as a run folder does, and read."""
    return json.loads(json.dumps(to_plain(value), allow_nan=False))


@given(values)
def test_a_value_comes_back_so_that_no_other_is_stored_like_it(value):
    assert described(from_plain(stored(value))) == described(value)


class Kind(Enum):
    NEAR = "near"


class Settings(BaseModel):
    cap_m: float | str | None = 1.0
    names: set[str] = set()
    by_number: dict[int, float] = {}


SETTINGS = (
    Settings(),
    Settings(cap_m=math.inf),
    Settings(cap_m=-math.inf),
    Settings(cap_m=math.nan),
    Settings(cap_m=None),
    Settings(cap_m="inf"),
    Settings(cap_m="nan"),
    Settings(names={"a", "b"}),
    Settings(by_number={1: math.inf}),
)


def test_each_setting_of_a_part_has_one_digest_and_no_other_has_it():
    digests = [part_digest([], "Mine", settings, {}) for settings in SETTINGS]
    assert len(set(digests)) == len(SETTINGS)
    again = [part_digest([], "Mine", settings.model_copy(deep=True), {}) for settings in SETTINGS]
    assert again == digests


@pytest.mark.parametrize("settings", SETTINGS)
def test_the_settings_of_a_part_come_back_from_a_run_folder(tmp_path, settings):
    facts = PartFacts("mine", "m:Mine", "mine", None, None, {}, {}, "", settings.model_dump())
    write_json(tmp_path / "facts.json", json_of(facts))
    data = (tmp_path / "facts.json").read_bytes()
    assert repr(read_record(PartFacts, data, "facts.json").settings) == repr(facts.settings)


def test_one_setting_is_entered_twice_and_two_have_two_keys():
    entered = [
        math.nan,
        "nan",
        math.inf,
        {"x": math.inf},
        {1: 2},
        {"1": 2},
        Kind.NEAR,
        np.arange(3),
    ]
    keys_of = []
    for value in (*entered, np.arange(3.0)):
        with Inputs() as inputs:
            inputs.setting("value", value)
            inputs.setting("value", value)
        keys_of.append(inputs.key)
    assert len(set(keys_of)) == len(keys_of)
    with Inputs() as inputs:
        inputs.setting("value", np.float64(0.5))
        inputs.setting("value", 0.5)
