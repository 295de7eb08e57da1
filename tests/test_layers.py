"""Data flows one way (docs/architecture.md): a room imports what stands before it in `ROOMS`, never
what stands after it. Folders inside a room have an order too.
"""

import ast
import re

import pytest

from tests.source_modules import PACKAGES, modules
from tests.statistics_imports import computing_imports

A = "alpasim_plugin."

# What every room may import. Within it, too, a folder imports only those before it.
BASE = (A + "core", A + "core.files", A + "core.parts")
CLOUDS = (A + "gaussians", A + "gaussians.files", A + "gaussians.raster")
GAUSSIANS = (*CLOUDS, A + "gaussians.scene", A + "gaussians.fit")
LOG = (A + "log.wire", A + "log")
RUN_FOLDER = A + "log.run_folder"
# The rooms, and the folders inside of them, in the order in which data flows, and what each may
# import besides itself and `BASE`.
STAGES = {
    A + "world": (),
    A + "cameras": (),
    A + "gaussians": (A + "cameras",),
    A + "gaussians.files": (A + "gaussians",),
    A + "gaussians.raster": (A + "gaussians", A + "cameras"),
    A + "gaussians.scene": CLOUDS,
    A + "gaussians.fit": (A + "cameras", *CLOUDS, A + "gaussians.scene"),
    A + "streets": (A + "world", *CLOUDS, A + "gaussians.scene"),
    "scenarios": (A + "world", A + "cameras"),
    A + "renderers": (A + "world", A + "cameras", *GAUSSIANS, A + "streets"),
    A + "drives": (A + "world", A + "cameras", *GAUSSIANS, "scenarios"),
    A + "fixers.network": (),
    A + "fixers.semantic_map": (A + "world", A + "cameras", *CLOUDS),
    A + "fixers": (
        A + "world",
        A + "cameras",
        *CLOUDS,
        A + "fixers.network",
        A + "fixers.semantic_map",
    ),
    "policies": (A + "world",),
    A + "control": (),
    A + "log.wire": (),
    A + "log": (A + "log.wire",),
    RUN_FOLDER: LOG,
    A + "alpasim.client": (A + "world", A + "control", *LOG),  # parts that are a service's
    "evaluators.results": (RUN_FOLDER,),
    "evaluators.metrics": (RUN_FOLDER,),
    "evaluators.statistics": (RUN_FOLDER, "evaluators.results", "evaluators.metrics"),
    "evaluators.alpasim": ("evaluators.metrics", "evaluators.statistics"),
    "evaluators.pages": (
        A + "cameras",
        *LOG,
        RUN_FOLDER,
        "evaluators.results",
        "evaluators.metrics",
        "evaluators.statistics",
    ),
}
# The public face of the evaluators: it imports names of its folders, and holds nothing else.
FACES = ("evaluators",)
# These compose the stages: each may import everything that stands before it, but no plug-in room.
AFTER_THE_STAGES = (A + "runs", A + "alpasim", A + "gym", A + "cli")
# Rooms that register themselves by entry points, as another distribution does. Nobody imports them.
PLUG_INS = (A + "block_fixers", A + "lab")
ROOMS = (*BASE, *STAGES, *FACES, *AFTER_THE_STAGES, *PLUG_INS)


def room_of(module):
    """Return the innermost room that a module lies in; None for the face of the package."""
    rooms = [room for room in ROOMS if module == room or module.startswith(room + ".")]
    return max(rooms, key=len, default=None)


def imported(nodes):
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.split(".")[0] in PACKAGES}


def may_import(room):
    """Return the rooms that a room may import besides itself."""
    if room in BASE:
        return set(BASE[: BASE.index(room)])
    if room in STAGES:
        return {*BASE, *STAGES[room]}
    return set(ROOMS[: ROOMS.index(room)])  # the laboratory may use the block generators


def upward_imports(module):
    """Return a line for every import that a module's room may not make."""
    room = room_of(module.name)
    if room is None:
        return []
    allowed = may_import(room)
    if module.path.name == "__init__.py":  # a face gives names of the folders below it
        allowed = {*allowed, *(name for name in ROOMS if name.startswith(room + "."))}
    found = {(name, room_of(name)) for name in imported(module.nodes)}
    return [
        f"{module.name} imports {name}"
        for name, target in sorted(found, key=str)
        if target not in (None, room, *allowed)
    ]


def test_every_module_lies_in_a_room():
    faces = {
        "alpasim_plugin",
        "simrun",
        "configs",
        "configs.can",
        "configs.fixers",
        "configs.paper",
    }
    assert {module.name for module in modules() if room_of(module.name) is None} - faces == set()
    assert {
        room for room in ROOMS if not any(room_of(module.name) == room for module in modules())
    } <= set(PLUG_INS)


def test_rooms_import_only_rooms_that_stand_before_them():
    assert [line for module in modules() for line in upward_imports(module)] == []


def test_no_room_imports_in_a_circle():
    """Modules of one room may import one another, but not in a circle either, imports inside
    functions included.
    """
    arrows = {module.name: targets_of(module) for module in modules()}
    done = set()
    path = []

    def visit(name):
        if name in path:
            return [*path[path.index(name) :], name]
        if name in done or name not in arrows:
            return []
        path.append(name)
        circle = next((found for target in sorted(arrows[name]) if (found := visit(target))), [])
        path.pop()
        done.add(name)
        return circle

    assert [circle for name in arrows if (circle := visit(name))] == []


def targets_of(module):
    """Return the modules that a module imports when it runs: not what only type checkers import,
    nor a package for one of its modules.
    """
    names = {one.name for one in modules()}
    guarded = {
        id(inner) for node in module.nodes if is_for_type_checkers(node) for inner in ast.walk(node)
    }
    found = set()
    for node in module.nodes:
        if id(node) in guarded:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inner & names or {node.module}
    return (found & names) - {module.name}


def is_for_type_checkers(node):
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


@pytest.mark.parametrize("room", PLUG_INS)
def test_the_core_does_not_name_a_plug_in_room(room):
    """A string that names one of their modules is an import too: it would break where the room is
    not installed.
    """
    word = re.compile(re.escape(room) + r"\b")
    outside = [module for module in modules() if room_of(module.name) not in PLUG_INS]
    assert [module.name for module in outside if word.search(module.path.read_text())] == []


def test_evaluators_do_not_load_torch():
    own = [module for module in modules() if module.name.startswith("evaluators")]
    top = {
        m.name: {
            alias.name for node in m.top if isinstance(node, ast.Import) for alias in node.names
        }
        for m in own
    }
    assert [
        name for name, names in top.items() if any(one.split(".")[0] == "torch" for one in names)
    ] == []
    assert [
        m.name
        for m in own
        if any(
            isinstance(n, ast.ImportFrom) and (n.module or "").split(".")[0] == "torch"
            for n in m.top
        )
    ] == []


def test_no_global_random_generator_is_used():
    wrong = []
    for module in modules():
        for node in module.nodes:
            if (
                isinstance(node, ast.Attribute)
                and isinstance(node.value, ast.Attribute)
                and node.value.attr == "random"
            ):
                if node.attr not in {"Generator", "Philox", "SeedSequence"}:
                    wrong.append(f"{module.path}:{node.lineno}: np.random.{node.attr}")
            elif isinstance(node, ast.Import) and any(
                alias.name == "random" for alias in node.names
            ):
                wrong.append(f"{module.path}:{node.lineno}: import random")
    assert wrong == []


TARGET = re.compile(r"((?:alpasim_plugin|evaluators|policies|scenarios)(?:\.\w+)+)(?::\w+)?")


def named_modules(module):
    """Return the modules of the project that a source file names in strings."""
    texts = (
        node.value
        for node in module.nodes
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
    return {match[1] for text in texts if (match := TARGET.fullmatch(text))}


def test_no_room_names_a_module_of_a_later_room_in_a_string():
    """Parts are registered by the room that has them; whoever names one in a string imports it."""
    wrong = []
    for module in modules():
        room = room_of(module.name)
        if room is None:
            continue
        allowed = {None, room, *may_import(room)}
        wrong += [
            f"{module.name} names {name}"
            for name in sorted(named_modules(module))
            if room_of(name) not in allowed
        ]
    assert wrong == []


# Verb -> what it calls that makes a result, and no other verb or server calls. All else is made by
# `runs`, and stored.
MAKERS = {
    "check": {"reduce_rollout"},  # whether a log that is driven again has the same outcome
    "compare": {"Comparison", "compare_runs", "compare_within"},
    "gate": {
        "Baseline",
        "GateSpec",
        "boundary_verdict",
        "check_gate",
        "check_matches",
        "check_number_of_scenes",
        "is_repeatable",
        "load_gate",
        "read_baseline",
        "table_of_run",
        "write_baseline",
    },
    # The question that a run drives until it is decided, and whether a baseline is one of its own.
    "run": {"Question", "base_named", "load_gate", "metric_question", "variants_of"},
    "score": {"worst_code"},  # of several presets
    "why": {"worst_failure"},  # the rollout that a run stands for
}


def test_a_verb_makes_no_result_beside_its_own():
    """Terminal, page and file say the same where one of them made it."""
    rooms = tuple(A + room for room in ("alpasim", "gym", "cli"))
    imports = {
        module.name.rsplit(".", 1)[-1]: computing_imports(module.nodes)
        for module in modules()
        if room_of(module.name) in rooms
    }
    assert {name: {*made} for name, made in imports.items() if made} == MAKERS
