"""YAML with positions: merging, overrides, bounds, and errors that say where."""

from typing import Annotated, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict, Field

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.config import (
    apply_overrides,
    load_yaml,
    own_or_shipped,
    parse,
    validate,
)
from tests.examples import examples


class Wheel(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    kind: Literal["wheel"]
    radius_m: float = Field(gt=0, description="Radius.")


class Door(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    kind: Literal["door"]
    side: Literal["left", "right"] = "left"


class Car(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    version: Literal[1] = Field(description="Version: 1.")
    length_m: float = Field(gt=0, description="Length.")
    doors: int = 4
    parts: tuple[Wheel | Door, ...] = Field(default=())
    size_m: tuple[float, float] = (1.0, 2.0)


AnyPart = Annotated[Wheel | Door, Field(discriminator="kind")]


class Tagged(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    parts: tuple[AnyPart, ...]


def write(tmp_path, text, name="a.yaml"):
    path = tmp_path / name
    path.write_text(text)
    return path


def error_of(tmp_path, text, model=Car):
    path = write(tmp_path, text)
    with pytest.raises(InputError) as e:
        validate(model, load_yaml(path))
    assert str(path) in e.value.message
    return e.value


def test_numbers_and_words_follow_yaml_1_2(tmp_path):
    data = load_yaml(
        write(
            tmp_path,
            "a: 1e-3\nb: no\nc: 12:30\nd: 8_000_000\ne: 0x1F\nf: ~\ng: true\nh: 010\ni: -.5\nj: 1.\n",
        )
    ).data
    assert data == {
        "a": 0.001,
        "b": "no",
        "c": "12:30",
        "d": 8_000_000,
        "e": 31,
        "f": None,
        "g": True,
        "h": 10,
        "i": -0.5,
        "j": 1.0,
    }


def test_every_key_knows_its_line_and_column(tmp_path):
    document = load_yaml(write(tmp_path, "a: 1\nb:\n  - c: 2\n    d: 3\n"))
    assert (document.mark(("b", 0, "d")).line, document.mark(("b", 0, "d")).column) == (4, 5)
    assert document.mark(("b", 0, "missing")).line == 3


@pytest.mark.parametrize(
    ("text", "where", "found"),
    [
        ("a: [1, 2\nb: 3\n", ":2:", "not valid YAML"),
        ("a: 1\n b: 2\n", ":2:", "not valid YAML"),
        ("a: 1\n\tb: 2\n", ":2:", "not valid YAML"),
        ('a: "open\n', ":", "not valid YAML"),
        ("a: 1\nb: 2\na: 3\n", ":3:1", "duplicate key 'a', first at line 1"),
        ("a: &x 1\nb:\n  <<: {c: 1}\n", ":3:3", "merge key"),
        ("? [1, 2]\n: 3\n", ":1:", "a key that is not text"),
        ("a: !!python/object/apply:os.system ['true']\n", ":1:4", ""),
        ("a: &x [*x]\n", ":1:", "contains itself"),
        ("a: *nowhere\n", ":1:4", "undefined alias"),
        ("a: 1\n---\nb: 2\n", ":2:", "not valid YAML"),
    ],
)
def test_bad_yaml_is_refused_where_it_stands(tmp_path, text, where, found):
    path = write(tmp_path, text)
    with pytest.raises(InputError) as e:
        load_yaml(path)
    assert f"{path.name}{where}" in e.value.message
    assert found in e.value.message
    assert e.value.hint


def test_alias_bomb_is_stopped(tmp_path):
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 9)]
    with pytest.raises(InputError, match="once aliases are expanded"):
        load_yaml(write(tmp_path, "\n".join(lines)))


@pytest.mark.parametrize(
    "levels", [60, 900, 5_000]
)  # 5000: the compiled parser's own bound, where it has one, is met first
@pytest.mark.parametrize(("before", "after"), [("[", "]"), ("{a: ", "}"), ("- ", "")])
def test_deep_nesting_is_stopped(tmp_path, before, after, levels):
    with pytest.raises(InputError, match="nested deeper") as caught:
        load_yaml(write(tmp_path, before * levels + after * levels))
    assert "flatten the file" in caught.value.hint


def test_missing_folder_and_binary_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_yaml(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="a folder, not a file"):
        load_yaml(tmp_path)
    (tmp_path / "b.yaml").write_bytes(b"a: \xff\xfe\n")
    with pytest.raises(InputError, match="byte 3 is not UTF-8"):
        load_yaml(tmp_path / "b.yaml")


def test_extends_merges_first_to_last_and_keeps_positions(tmp_path):
    write(tmp_path, "version: 1\nlength_m: 3\nsize_m: [1, 2]\n", "one.yaml")
    write(tmp_path, "length_m: 4\ndoors: 2\n", "two.yaml")
    document = load_yaml(write(tmp_path, "extends: [one.yaml, two.yaml]\nsize_m: [5, 6]\n"))
    assert document.data == {"version": 1, "length_m": 4, "doors": 2, "size_m": [5, 6]}
    assert document.mark(("length_m",)).file.endswith("two.yaml")
    assert document.mark(("size_m", 1)).file.endswith("a.yaml")
    assert document.mark(("version",)).line == 1


def test_extends_in_a_circle_or_to_nowhere_is_refused(tmp_path):
    write(tmp_path, "extends: a.yaml\n", "b.yaml")
    with pytest.raises(InputError, match="through extends"):
        load_yaml(write(tmp_path, "extends: [b.yaml]\n"))
    with pytest.raises(InputError, match=r"extends 'c\.yaml'"):
        load_yaml(write(tmp_path, "extends: [c.yaml]\n"))
    with pytest.raises(InputError, match="give a list of paths"):
        load_yaml(write(tmp_path, "extends: {a: 1}\n"))


@pytest.mark.parametrize(
    ("text", "line", "found", "hint"),
    [
        (
            "version: 1\nlenght_m: 3\nlength_m: 3\n",
            ":2:1",
            "unknown key 'lenght_m'",
            "did you mean 'length_m'?",
        ),
        ("version: 1\nlength_m: -3\n", ":2:1", "length_m = -3", "greater than 0"),
        ("version: 1\nlength_m: '3'\n", ":2:1", "length_m = '3'", "number"),
        ("version: 1\nlength_m: 3\ndoors: 4.5\n", ":3:1", "doors = 4.5", "integer"),
        (
            "version: 1\nlength_m: 3\ndoors: true\n",
            ":3:1",
            "doors = True",
            "integer",
        ),
        ("version: 1\nlength_m: .inf\n", ":2:1", "the number .inf", "finite"),
        ("version: 1\nlength_m: .nan\n", ":2:1", "the number .nan", "finite"),
        ("length_m: 3\n", ":1:1", "the file has no 'version'", "add version: Version"),
        ("version: 2\nlength_m: 3\n", ":1:1", "version", "valid: 1"),
        ("version: 1\nlength_m: 3\nsize_m: [1, 2, 3]\n", ":3:", "size_m", ""),
        ("- 1\n- 2\n", ":1:1", "the file = [1, 2]", "object"),
        ("", "", "the file is empty", "object"),
    ],
)
def test_wrong_content_is_named_with_position_and_hint(tmp_path, text, line, found, hint):
    e = error_of(tmp_path, text)
    assert line in e.message
    assert found in e.message
    assert hint in e.hint


def test_tagged_unions_name_the_nearest_kind_and_the_keys_of_that_kind(tmp_path):
    e = error_of(tmp_path, "parts:\n  - {kind: wheeel, radius_m: 1}\n", Tagged)
    assert "parts[0].kind is 'wheeel'" in e.message
    assert "did you mean 'wheel'?" in e.hint
    assert ":2:5" in e.message
    e = error_of(tmp_path, "parts:\n  - kind: wheel\n    radius: 1\n", Tagged)
    assert "unknown key 'radius'" in e.message + e.hint
    assert "a.yaml:3:5" in e.message + e.message
    e = error_of(tmp_path, "parts:\n  - {radius_m: 1}\n", Tagged)
    assert "has no 'kind'" in e.message
    assert "wheel" in e.hint


def test_overrides_set_values_by_key_index_and_id(tmp_path):
    document = load_yaml(
        write(tmp_path, "a: {b: 1}\nc:\n  - {id: lead, v: 1}\n  - {id: rear, v: 2}\n")
    )
    changed = apply_overrides(
        document, ["a.b=7", "a.new=[1, 2]", "c.rear.v=9", "c.0.v=1e1", "text=no"]
    )
    assert changed.data == {
        "a": {"b": 7, "new": [1, 2]},
        "c": [{"id": "lead", "v": 10.0}, {"id": "rear", "v": 9}],
        "text": "no",
    }
    assert document.data["a"] == {"b": 1}, "the document itself is not changed"


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("length_m", "no KEY=VALUE"),
        ("=3", "no KEY=VALUE"),
        ("length_m.x=3", "holds a value, not keys"),
        ("c.third.v=1", "no list item 'third'"),
        ("c.7=1", "no list item '7'"),
        ("a=[1", "not valid YAML"),
    ],
)
def test_bad_overrides_are_refused(tmp_path, text, found):
    document = load_yaml(write(tmp_path, "length_m: 3\nc: [{id: lead}]\n"))
    with pytest.raises(InputError) as e:
        apply_overrides(document, [text])
    assert found in e.value.message
    assert f"--set {text}" in e.value.message


@settings(deadline=None, max_examples=examples(80))
@given(st.text(max_size=60))
def test_any_text_gives_data_or_a_clear_error(text):
    error = None
    try:
        parse(text, "text")
    except InputError as e:
        error = e
    assert error is None or (error.message and error.hint)


def test_a_users_own_file_or_a_shipped_one_is_found_by_name(tmp_path):
    library = tmp_path / "library"
    library.mkdir()
    (library / "strict.yaml").write_text("a: 1\n")
    assert own_or_shipped("strict", library, "gate") == library / "strict.yaml"
    own = tmp_path / "strict"
    own.write_text("a: 2\n")
    assert own_or_shipped(str(own), library, "gate") == own
    with pytest.raises(InputError, match=r"--gate .*: a folder, not a file"):
        own_or_shipped(str(library), library, "gate", "--gate")
    with pytest.raises(InputError, match="strickt: no such file") as refused:
        own_or_shipped("strickt", library, "gate")
    assert refused.value.hint.startswith("did you mean 'strict'?")
    with pytest.raises(InputError):  # a path is no name of a shipped file
        own_or_shipped("../library/strict", library, "gate")
