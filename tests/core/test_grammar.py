"""The grammar of renderers: what is written comes back, and no sign of a path or an address is
taken for one of the grammar.
"""

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from alpasim_plugin.cli.options import split_overrides
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import (
    require_installed,
    resolve,
    resolve_renderer,
    split_names,
)
from alpasim_plugin.core.parts.grammar import RendererName, parse_renderer, split_label
from alpasim_plugin.core.parts.source import load

words = st.from_regex(r"[a-z][a-z0-9_-]{0,8}", fullmatch=True)
keys = st.from_regex(r"[a-z][a-z0-9_.]{0,6}", fullmatch=True)
classes = st.from_regex(r"[A-Z][a-z]{0,6}", fullmatch=True)
FIXERS = ("onefixer", "difix", "3dgs-enhancer")
names_of_fixers = st.sampled_from(FIXERS)
folders = st.from_regex(
    r"(/|\./|[a-z0-9]{1,3}[a-z+@. -]{0,6}/)?([a-z+@. -]{1,6}/){0,3}", fullmatch=True
)
files = st.from_regex(r"[a-z][a-z0-9_+-]{0,8}", fullmatch=True)
paths = st.builds("{}{}.py:{}".format, folders, files, classes).filter(
    lambda path: path.partition("+")[0] not in FIXERS
)
targets = st.one_of(paths, st.builds("{}.{}:{}".format, words, words, classes))
hosts = st.sampled_from(["host:50051", "[::1]:1", "127.0.0.1:1?scene=a+b", "[fe80::1]:50051"])
addresses = st.builds("nre://{}".format, hosts)
settings = st.lists(
    st.builds("{}={}".format, keys, st.from_regex(r"[a-z0-9/.:+-]{1,8}", fullmatch=True)),
    max_size=3,
).map(tuple)
fixers = st.one_of(names_of_fixers, targets)
bases = st.one_of(words, targets, addresses)
steps = st.sampled_from(["", "1", "4", "12"])


@given(fixers, steps, settings, bases)
def test_a_fixer_over_a_renderer_comes_back(part, count, chosen, base):
    name = RendererName(part, count, chosen, base)
    assert parse_renderer(str(name), FIXERS) == name


@given(fixers, steps, settings)
def test_a_part_alone_comes_back(part, count, chosen):
    name = RendererName(part, count, chosen)
    assert parse_renderer(str(name), FIXERS) == name


@given(addresses)
def test_an_address_is_one_part(address):
    assert parse_renderer(address, FIXERS) == RendererName(address)


@given(st.lists(st.builds(RendererName, fixers, steps, settings, bases), min_size=1, max_size=4))
def test_a_list_of_renderers_comes_back(renderers):
    assert [
        parse_renderer(name, FIXERS) for name in split_names(",".join(map(str, renderers)))
    ] == (renderers)


@given(st.builds(RendererName, fixers, steps, settings), keys, words)
def test_an_override_of_one_renderer_comes_back(renderer, key, value):
    override = f"{renderer}:fixer.{key}={value}"
    assert split_label(override) == (str(renderer), f"fixer.{key}={value}")
    assert split_overrides([override]) == ((), (f"{renderer}:{key}={value}",))
    assert split_label(f"{key}=/a:{value}=b") == ("", f"{key}=/a:{value}=b")


@pytest.mark.parametrize(
    "text", ["onefixer[abc]", "onefixer[]", "onefixer[a=1][b=2]", "onefixer[a=1]+clean[b=2]"]
)
def test_brackets_without_settings_and_settings_twice_are_refused(text):
    with pytest.raises(InputError):
        parse_renderer(text, FIXERS)


PARTS = """
class Drives:
    sensors = ()
    def reset(self, seed, route): ...
    def act(self, observation): ...

class Shows:
    def render(self, request): ...

class Fixes:
    def reset(self, seed): ...
    def step(self, block, maps): ...
"""
PART = """
import {helper}

class Mine:
    sensors = ()
    def reset(self, seed, route): ...
    def act(self, observation): ...
    def render(self, request): ...
"""


def test_a_file_behind_a_link_and_a_plus_in_its_folder_is_a_part(tmp_path):
    folder = tmp_path / "a+b"
    folder.mkdir()
    (folder / "mine.py").write_text(PART.format(helper="helper_behind_a_link"))
    (folder / "helper_behind_a_link.py").write_text("")
    os.symlink(folder / "mine.py", tmp_path / "link.py")
    assert load(f"{tmp_path / 'link.py'}:Mine", "policy").__name__ == "Mine"
    code = resolve("policy", f"{tmp_path / 'link.py'}:Mine").code
    assert {os.path.basename(path) for path in code} == {"mine.py", "helper_behind_a_link.py"}


@pytest.mark.parametrize("plus", ["a+b/mine.py", "c/a+b/mine.py", "mine+old.py", "a+b/c+d/my+n.py"])
def test_a_plus_in_any_part_of_a_path_belongs_to_the_path(tmp_path, monkeypatch, plus):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / plus
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(PARTS)
    assert resolve("policy", f"{plus}:Drives").target == f"{file}:Drives"
    for name, meant in (
        ("{}:Shows", "{}:Shows"),
        ("{}:Fixes", "{}:Fixes+3dgs"),
        ("{}:Fixes+clean", "{}:Fixes+clean"),
        ("{}:Fixes+{}:Shows", "{}:Fixes+{}:Shows"),
        ("identity[tolerance_m=0.5]+{}:Shows", "identity[tolerance_m=0.5]+{}:Shows"),
    ):
        assert str(resolve_renderer(name.format(plus, plus))) == meant.format(plus, plus)


def test_a_plus_before_a_path_that_is_not_there_may_stand_after_a_misspelt_fixer(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as caught:
        resolve_renderer("onefixr+b/mine.py:Shows")
    assert "onefixr+b/mine.py" in caught.value.message
    assert "onefixer" in caught.value.hint


@pytest.mark.parametrize("name", ["nre://[::1]:1", "onefixer+nre://[::1]:1", "b/mine.py:Shows"])
def test_an_address_or_a_file_that_a_file_names_is_named_in_the_refusal(name):
    with pytest.raises(InputError, match="not installed"):
        require_installed([name], "run.json")
