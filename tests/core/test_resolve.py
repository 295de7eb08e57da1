"""What a name stands for, what a part declares, and what its digest sees."""

from functools import partial
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.interfaces import BlockRule, Fixer, Renderer
from alpasim_plugin.core.parts import build, complete, names, resolve, resolve_renderer
from alpasim_plugin.core.parts.blame import is_own
from alpasim_plugin.core.parts.source import code_digest, code_files, reached
from alpasim_plugin.core.parts.spec import KINDS
from evaluators.metrics.parts import PARTS
from evaluators.metrics.presets import PRESETS


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_shipped_part_resolves_and_has_a_digest_and_help(kind):
    for name, text in names(kind).items():  # type: ignore[arg-type]
        behind = {"/": "127.0.0.1:1", ":": "sh serve.sh"}.get(name[-1], "")
        if name == "can://":
            behind = "virtual:parts"
        spec = resolve(kind, name + behind)  # type: ignore[arg-type]
        assert (spec.digest is None) == bool(behind), (
            name
        )  # what is behind an address or a command is not known here
        assert text
        assert "\n" not in text


def test_an_import_path_is_a_renderer_or_a_fixer_by_what_it_can_do(tmp_path):
    file = tmp_path / "own.py"
    file.write_text(
        "class Shows:\n    def render(self, request): ...\n"
        "class Fixes:\n    def reset(self, seed): ...\n    def step(self, block, maps): ...\n"
    )
    assert resolve_renderer(f"{file}:Shows").fixer is None
    assert str(resolve_renderer(f"{file}:Fixes")) == f"{file}:Fixes+3dgs"
    assert str(resolve_renderer(f"{file}:Fixes+{file}:Shows")) == f"{file}:Fixes+{file}:Shows"


def test_a_module_that_raises_is_told_with_what_it_raised(tmp_path):
    file = tmp_path / "raises.py"
    file.write_text("raise RuntimeError('no licence')\n")
    with pytest.raises(InputError, match="RuntimeError: no licence"):
        resolve("policy", f"{file}:Mine")


def test_a_file_without_its_class_leads_to_its_classes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text("class Mine: ...\n")
    for name in ("mine.py", "mine"):
        with pytest.raises(InputError) as caught:
            resolve("policy", name)
        assert "mine.py:Mine" in caught.value.hint


def test_the_digest_follows_imports_wherever_they_stand(tmp_path):
    package = tmp_path / "pack"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "part.py").write_text(
        "from typing import TYPE_CHECKING\n\nfrom . import near\n"
        "from pack.other import (\n    one,  # a comment, with a comma\n    two,\n)\n\n"
        "if TYPE_CHECKING:\n    from pack.typed import Unused\n\n\ndef late():\n    import beside\n"
    )
    for name in ("near", "other", "typed"):
        (package / f"{name}.py").write_text(f"NAME = '{name}'\n")
    (tmp_path / "beside.py").write_text("import pack.part\n")
    part = package / "part.py"
    names = {Path(path).stem for path in reached(part)}
    assert names == {"__init__", "part", "near", "other", "typed", "beside"}
    before = code_digest(part)
    (tmp_path / "beside.py").write_text("import pack.part  # edited\n")
    assert code_digest(part) != before


@pytest.mark.parametrize("place", [".", "elsewhere"])
def test_a_compiled_module_is_code_of_the_part_that_imports_it(tmp_path, monkeypatch, place):
    folder = tmp_path / place
    folder.mkdir(exist_ok=True)
    compiled = folder / f"compiled_of_a_user{EXTENSION_SUFFIXES[0]}"
    compiled.write_bytes(b"first")
    monkeypatch.syspath_prepend(folder)
    part = tmp_path / "part.py"
    part.write_text("def late():\n    import compiled_of_a_user\n")
    before = code_digest(part)
    assert {Path(path).name for path in code_files(part)} == {"part.py", compiled.name}
    assert resolve("policy", f"{part}:late").target == f"{part}:late"
    compiled.write_bytes(b"compiled again")
    assert code_digest(part) != before


def test_an_installed_part_does_not_reach_other_distributions(tmp_path):
    site = tmp_path / "site-packages"
    site.mkdir()
    (site / "mine.py").write_text("import theirs\nimport alpasim_plugin.core.types\n")
    (site / "theirs.py").write_text("")
    found = {Path(path).name for path in reached(site / "mine.py")}
    assert found == {"mine.py"}


def test_optional_members_get_their_defaults_and_required_ones_are_named():
    class Bare:
        def render(self, request):
            return request

    renderer = complete(Bare(), Renderer)
    assert (renderer.lookahead, renderer.block, dict(renderer.stage_ms), renderer.facts()) == (
        0,
        None,
        {},
        {},
    )  # type: ignore[attr-defined]
    assert renderer.render_batch([1, 2]) == [1, 2]  # type: ignore[attr-defined]
    with pytest.raises(InputError, match="a Bare without reset, step"):
        complete(Bare(), Fixer)


def test_a_fixer_without_preview_previews_on_a_copy_of_itself():
    class Counts:
        blocks = BlockRule(2, 2)
        seen = 0

        def reset(self, seed):
            self.seen = 0

        def step(self, block, maps):
            self.seen += len(block)
            return [self.seen] * len(block)

    fixer = complete(Counts(), Fixer)
    assert fixer.preview([1], []) == [1]  # type: ignore[attr-defined]
    assert fixer.seen == 0
    assert fixer.step([1, 2], []) == [2, 2]


def test_a_module_edited_after_its_import_is_refused(tmp_path):
    file = tmp_path / "edited.py"
    file.write_text("class Mine:\n    controller = 'perfect'\n")
    assert resolve("policy", f"{file}:Mine").controller == "perfect"
    assert resolve("policy", f"{file}:Mine").controller == "perfect"
    file.write_text("class Mine:\n    controller = 'bicycle'\n")
    with pytest.raises(InputError):
        resolve("policy", f"{file}:Mine")


def test_a_class_named_through_its_package_has_the_digest_of_its_own_module(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    speeds = {"first_pack": 5.0, "equal_pack": 5.0, "edited_pack": 6.0}
    for name, speed_mps in speeds.items():
        Path(name).mkdir()
        Path(name, "__init__.py").write_text("from .inner import Mine\n")
        Path(name, "inner.py").write_text(f"class Mine:\n    speed_mps = {speed_mps}\n")
    first, equal, edited = (resolve("policy", f"{name}:Mine").digest for name in speeds)
    assert first == equal
    assert first != edited


def test_settings_in_brackets_make_another_arm_of_one_fixer():
    plain = resolve_renderer("identity")
    without = resolve_renderer("identity[references=0,tolerance_m=0.5]+clean")
    assert (without.name, str(without)) == (
        "identity[references=0,tolerance_m=0.5]+clean",
        "identity[references=0,tolerance_m=0.5]+clean",
    )
    assert without.fixer.settings.tolerance_m == 0.5  # type: ignore[union-attr]
    assert without.fixer.digest != plain.fixer.digest


@pytest.mark.parametrize(
    "name", ["clean[a=1]", "identity[]", "identity[a]", "identity[a=1", "identity[a=1][b=2]"]
)
def test_brackets_without_settings_are_refused(name):
    with pytest.raises(InputError, match="bracket"):
        resolve_renderer(name)


def test_shipped_evaluators_are_known_as_simruns():
    """They are functions with a preset bound to them; a user's function is none of simrun's."""
    preset = PRESETS["strict"]
    shipped = [build(resolve("evaluator", part.name), preset=preset) for part in PARTS]
    assert all(is_own(evaluator) for evaluator in shipped)
    assert not is_own(partial(len, preset))
