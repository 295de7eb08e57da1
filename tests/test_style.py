"""Private names of other libraries, names bound twice, places that print and read, keywords:
docs/architecture.md has the first rule.
"""

import ast
import re
from collections import Counter
from functools import cache

from tests.source_modules import REPO, dotted, foreign_names, modules

# Module -> why a user would wait a fifth longer without it. `goes`: it is on its way out.
ALLOWED: dict[str, str] = {
    "alpasim_plugin.lab.video_metrics.torchscript": "the I3D of FVD is published as TorchScript, and detectors are exchanged as such",
}
DEPRECATED = ("torch.jit",)
STANDARD = ("os._exit", "sys._getframe")  # documented, whatever their names


def is_private(name):
    return any(part.startswith("_") and not part.startswith("__") for part in name.split("."))


def private_uses(module):
    foreign = foreign_names(module)
    used = set(foreign.values())
    for node in module.nodes:
        name = dotted(node) if isinstance(node, ast.Attribute) else ""
        first, _, rest = name.partition(".")
        if rest and first in foreign:
            used.add(f"{foreign[first]}.{rest}")
    return {
        name
        for name in used - set(STANDARD)
        if is_private(name) or any(f"{name}.".startswith(f"{one}.") for one in DEPRECATED)
    }


def test_private_and_deprecated_names_of_other_libraries_are_used_only_where_it_is_said():
    found = {module.name: sorted(private_uses(module)) for module in modules()}
    used = {name: uses for name, uses in found.items() if uses}
    assert {name: uses for name, uses in used.items() if name not in ALLOWED} == {}
    assert [name for name in ALLOWED if name not in used and name in found] == []


# Module -> why it prints by itself.
PRINTERS = {
    "alpasim_plugin.core.printing": "it is the printer",
    "alpasim_plugin.core.subprocesses": "passes on what parts print",
    "alpasim_plugin.cli.output": "tables of rich, through `Escaped`",
    "alpasim_plugin.cli.docs": "pages of ours",
    "alpasim_plugin.alpasim.client.supervisor": "a program of the standard library alone",
    "alpasim_plugin.alpasim.bridge.client": "a wheel of its own",
    "alpasim_plugin.alpasim.bridge.build": "a program that builds that wheel",
}
PRINTING = {
    "print",
    "sys.stdout.write",
    "sys.stderr.write",
    "traceback.print_exc",
    "traceback.print_exception",
    "typer.echo",
    "typer.secho",
    "Console",
}


def calls_of(module):
    for node in module.nodes:
        if isinstance(node, ast.Call):
            yield dotted(node.func)


def test_text_is_printed_in_one_place_which_escapes_it():
    found = {
        module.name
        for module in modules()
        if not module.name.startswith("alpasim_plugin.lab") and PRINTING & {*calls_of(module)}
    }
    assert found - set(PRINTERS) == set()


def names_bound(statement):
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return [] if statement.decorator_list else [statement.name]
    if isinstance(statement, ast.AnnAssign) and statement.value is None:
        return []
    targets = statement.targets if isinstance(statement, ast.Assign) else []
    if isinstance(statement, ast.AnnAssign):
        targets = [statement.target]
    nodes = [inner for target in targets for inner in ast.walk(target)]
    return [
        node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    ]


def test_no_module_binds_a_name_twice():
    twice = {}
    for module in modules():
        counts = Counter(name for one in module.top for name in names_bound(one))
        names = [name for name, count in counts.items() if count > 1]
        if names:
            twice[module.name] = names
    assert twice == {}


# Module -> why it opens files by itself.
READERS = {
    "alpasim_plugin.core.files.reading": "it is the reader",
    "alpasim_plugin.core.printing": "the null device",
    "alpasim_plugin.core.files.arrays": "memory maps, after `check_regular`",
    "alpasim_plugin.core.files.tables": "parquet, after `check_regular`",
    "alpasim_plugin.core.files.atomic": "what it has just written",
    "alpasim_plugin.core.files.lock": "a lock file, after a check of its own",
    "alpasim_plugin.gaussians.files.ply": "large arrays, of a stream from `open_regular`",
    "alpasim_plugin.cli.new": "templates inside the package",
    "alpasim_plugin.alpasim.bridge.build": "sources inside the package",
    "alpasim_plugin.core.kernel_sources": "sources inside the package",
}
READING = {"open", "os.open", "np.load", "np.fromfile", "np.memmap", "cv2.imread", "pq.ParquetFile"}


def reads_files(module):
    """Tell whether a module opens files for reading other than by `alpasim_plugin.core.files`."""
    for node in module.nodes:
        if not isinstance(node, ast.Call):
            continue
        mode = node.args[0].value if node.args and isinstance(node.args[0], ast.Constant) else ""
        name = node.func.attr if isinstance(node.func, ast.Attribute) else ""
        if (
            dotted(node.func) in READING
            or (name in ("read_bytes", "read_text") and not node.args)
            or (name == "open" and mode in ("r", "rb"))
        ):
            return True
    return False


RAISING = {"exists", "is_file", "is_dir", "is_symlink", "resolve"}


def test_paths_of_users_go_through_functions_that_do_not_raise():
    """`pathlib` raises for names that are too long and for circles of links; `os.path` and
    `alpasim_plugin.core.files.real` do not.
    """
    found = [
        f"{module.name}: {ast.unparse(node)}"
        for module in modules()
        if not module.name.startswith("alpasim_plugin.lab")
        for node in module.nodes
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr in RAISING
        and not (node.args or node.keywords or "__file__" in ast.unparse(node))
    ]
    assert found == []


def test_files_are_read_in_one_place_which_refuses_pipes_and_devices():
    found = {
        module.name
        for module in modules()
        if not module.name.startswith("alpasim_plugin.lab") and reads_files(module)
    }
    assert found - set(READERS) == set()


MAKES = ("torch.tensor", "torch.as_tensor", "torch.from_numpy")


def makes_the_host_wait(call):
    """Return whether a call sends a tensor of the host to a device, and waits for it."""
    if dotted(call.func) in MAKES:
        found = [ast.unparse(word.value) for word in call.keywords if word.arg == "device"]
        return found not in ([], ["'cpu'"])
    sends = isinstance(call.func, ast.Attribute) and call.func.attr == "to"
    inner = {dotted(node.func) for node in ast.walk(call.func) if isinstance(node, ast.Call)}
    return sends and inner & set(MAKES) and not dotted(call.args[0]).startswith("torch.")


def asks_for_the_device(node):
    """Return whether code decides by the device that it runs on."""
    if isinstance(node, ast.Compare):
        return re.search(r"'(cpu|cuda)", ast.unparse(node))
    return isinstance(node, ast.Attribute) and re.search(
        r"device\.type$|\.is_(cuda|cpu)$", ast.unparse(node)
    )


def test_one_place_chooses_by_device_and_sends_tensors_of_the_host_without_waiting():
    found = {
        f"{module.name}:{node.lineno}"
        for module in modules()
        if module.name != "alpasim_plugin.core.devices"
        for node in module.nodes
        if asks_for_the_device(node) or (isinstance(node, ast.Call) and makes_the_host_wait(node))
    }
    assert found == set()


@cache
def files_of_tests():
    """Return the syntax nodes of every file below tests/."""
    return {
        path.relative_to(REPO): tuple(ast.walk(ast.parse(path.read_text())))
        for path in sorted((REPO / "tests").rglob("*.py"))
    }


# Function -> how many arguments stand before its `dtype`.
BEFORE_DTYPE = {
    "np.array": 1,
    "np.asarray": 1,
    "np.asanyarray": 1,
    "np.ascontiguousarray": 1,
    "np.asfortranarray": 1,
    "np.require": 1,
    "np.zeros": 1,
    "np.ones": 1,
    "np.empty": 1,
    "np.zeros_like": 1,
    "np.ones_like": 1,
    "np.empty_like": 1,
    "np.identity": 1,
    "np.frombuffer": 1,
    "np.fromfile": 1,
    "np.fromiter": 1,
    "np.fromstring": 1,
    "np.loadtxt": 1,
    "np.memmap": 1,
    "np.full": 2,
    "np.full_like": 2,
    "np.sum": 2,
    "np.mean": 2,
    "np.prod": 2,
    "np.cumsum": 2,
    "np.cumprod": 2,
    "np.eye": 3,
    "np.arange": 3,
    "np.linspace": 5,
    "torch.as_tensor": 1,
}


def positional_dtypes(nodes):
    """Return the calls of numpy that give a dtype by position."""
    return [
        f"line {node.lineno}: {ast.unparse(node)}"
        for node in nodes
        if isinstance(node, ast.Call)
        and len(node.args) > BEFORE_DTYPE.get(dotted(node.func), len(node.args))
    ]


def test_the_type_of_numbers_has_its_keyword():
    """A second argument of `np.zeros` or a third of `np.full` is easily taken for a size or a
    value.
    """
    nodes = {module.path.relative_to(REPO): module.nodes for module in modules()}
    nodes.update(files_of_tests())
    calls = {str(path): positional_dtypes(inner) for path, inner in nodes.items()}
    assert {path: lines for path, lines in calls.items() if lines} == {}


def test_the_rule_of_keywords_sees_a_positional_type():
    tree = ast.parse("np.zeros(3, bool); np.full(3, 1, dtype=bool); x.astype(bool)")
    assert positional_dtypes(ast.walk(tree)) == ["line 1: np.zeros(3, bool)"]


def test_no_file_of_tests_is_imported_by_another():
    """Builders that several files use lie in modules without tests: who moves a test or runs one
    file alone then changes nothing else.
    """
    imports = []
    for path, nodes in files_of_tests().items():
        for node in nodes:
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            else:
                continue
            imports += [
                f"{path} imports {name}"
                for name in names
                if re.match(r"tests\.(\w+\.)*test_\w+$", name)
            ]
    assert imports == []
