"""Makers open nothing themselves: what a library opens was opened by simrun's reader before, which
records it.
"""

import ast
import re

import pytest

from tests.source_modules import dotted, foreign_names, modules

# What opens a file, by the name that it has in its library.
OPENERS = re.compile(
    r"""^(
    safetensors(\.\w+)*\.(load_file|safe_open) | torch(\.\w+)*\.load | cantools\..*load_file
    | cv2\.(VideoCapture|imread|imreadmulti|imreadanimation|imcount|FileStorage)
    | numpy\.(load|fromfile|memmap|loadtxt|genfromtxt) | numpy(\.\w+)*\.open_memmap
    | pyarrow(\.\w+)*\.(memory_map|OSFile|input_stream|open_file|open_stream|dataset|ParquetFile
        |ParquetDataset|read_\w+)
    | pandas\.read_\w+ | duckdb\.\w+ | sqlite3\.connect | h5py\.File | PIL\.Image\.open
    | tifffile\.\w+ | imageio(\.\w+)*\.\w+ | rasterio\.open | (av|_av|self\._av)\.open
    | zipfile\.(ZipFile|is_zipfile|Path) | tarfile\.(open|TarFile) | (gzip|bz2|lzma|io|codecs)\.open
    | (json|pickle|marshal|tomllib|plistlib)\.load | yaml\.\w*load\w* | ruamel(\.\w+)*\.load
    | xml(\.\w+)*\.(parse|iterparse) | mcap(\.\w+)*\.make_reader | mmap\.mmap | linecache\.\w+
    | urllib(\.\w+)*\.urlopen | scipy\.io\.\w+ | os\.(open|fdopen) | open
    )$""",
    re.X,
)
# What opens it for the record, or checks a path that is opened then.
RECORDING = {
    "check_regular",
    "open_regular",
    "check_parquet",
    "read_bytes",
    "read_text",
    "read_metadata",
}
TABLES = re.compile(r"_TABLE\.check$")
IN_MEMORY = {"io.BytesIO", "io.StringIO", "pa.BufferReader"}
WRITING = re.compile(r"^[wax]")
# Module and function -> why what it opens is in no record.
UNRECORDED = {
    "alpasim_plugin.core.cores.system_lines": "what the system says of this process",
    "alpasim_plugin.core.files.lock.one_writer": "a lock file",
    "alpasim_plugin.core.files.reading.open_regular": "it is the reader",
    "alpasim_plugin.core.parts.blame.__init__": "the note of a worker, which it makes",
    "alpasim_plugin.core.printing": "the null device",
    "alpasim_plugin.log.run_folder.sides.__init__": "a table in memory",
    "alpasim_plugin.runs.provenance._cpu_name": "what the system says of the processor",
}


def files_opened(module):
    """Yield function and text of each call by which a library opens a file for reading, unless the
    function records the file.
    """
    names = foreign_names(module)
    homes = {}
    for function in module.nodes:
        if isinstance(function, ast.FunctionDef):  # inner ones come after outer ones
            homes |= dict.fromkeys(ast.walk(function), function)
    for call in module.nodes:
        if not isinstance(call, ast.Call) or not opens_a_file(call, names):
            continue
        home = homes.get(call)
        if home is None or not records(home):
            yield home.name if home is not None else "", ast.unparse(call)


def opens_a_file(call, names):
    """Tell whether a call opens a file for reading."""
    written = dotted(call.func)
    first, _, rest = written.partition(".")
    name = ".".join(filter(None, (names.get(first, first), rest)))
    is_method = isinstance(call.func, ast.Attribute) and call.func.attr == "open"
    is_path = is_method and not call.args  # Path.open without a mode
    if not is_path and OPENERS.match(name) is None:
        return False
    if call.args and isinstance(call.args[0], ast.Call) and dotted(call.args[0].func) in IN_MEMORY:
        return False
    modes = [*call.args[1:2], *(word.value for word in call.keywords if word.arg == "mode")]
    return not any(
        isinstance(mode, ast.Constant) and WRITING.match(str(mode.value)) for mode in modes
    )


def records(function):
    """Tell whether a function opens by simrun's reader as well."""
    calls = [dotted(node.func) for node in ast.walk(function) if isinstance(node, ast.Call)]
    return any(name.rpartition(".")[2] in RECORDING or TABLES.search(name) for name in calls)


def test_what_a_library_opens_is_recorded():
    opened = {
        f"{module.name}.{function}: {text}"
        for module in modules()
        if not module.name.startswith("alpasim_plugin.lab")
        for function, text in files_opened(module)
        if not {module.name, f"{module.name}.{function}"} & UNRECORDED.keys()
    }
    assert opened == set()


class Snippet:
    """A module of a test."""

    def __init__(self, text):
        self.nodes = tuple(ast.walk(ast.parse(text)))


@pytest.mark.parametrize(
    "text",
    [
        "import zipfile\ndef f(path):\n    return zipfile.ZipFile(path)",
        "from safetensors.torch import load_file\ndef f(path):\n    return load_file(path)",
        "import pyarrow.parquet as pq\ndef f(path):\n    return pq.read_table(path)",
        "import yaml\ndef f(stream):\n    return yaml.safe_load(stream)",
        "import cv2\nfilm = cv2.VideoCapture('film.mp4')",
        "import json\ndef f(stream):\n    return json.load(stream)",
        "import numpy as np\ndef f(path):\n    return np.load(path)",
        "import tifffile\ndef f(path):\n    return tifffile.imread(path)",
        "def f(path):\n    return path.open(encoding='utf-8')",
        "def f(path):\n    with open(path) as stream:\n        return stream.read()",
    ],
)
def test_each_library_that_opens_a_file_is_noticed(text):
    assert len([*files_opened(Snippet(text))]) == 1
    recorded = text.replace("(path):\n", "(path):\n    check_regular(path)\n")
    if recorded != text:
        assert [*files_opened(Snippet(recorded))] == []


@pytest.mark.parametrize(
    "text",
    [
        "import io, zipfile\ndef f(data):\n    return zipfile.ZipFile(io.BytesIO(data))",
        "import zipfile\ndef f(path):\n    return zipfile.ZipFile(path, 'w')",
        "def f(path):\n    return path.open('wb')",
    ],
)
def test_what_is_in_memory_or_written_is_no_input(text):
    assert [*files_opened(Snippet(text))] == []
