"""Functions and classes that a part of the user's has replaced in a library or in simrun: whatever
is computed with them after that is not what it says.
"""

import sys
from types import ModuleType

from alpasim_plugin import OWN_PACKAGES

WATCHED = ("builtins", "cv2", "math", "numpy", "scipy", "shapely", *OWN_PACKAGES)

_loaded: dict[str, dict[str, object]] = {}  # of this process, by module, once it is watched


def watch_code() -> None:
    """Remember the functions and classes of the modules that are loaded now."""
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in WATCHED and isinstance(module, ModuleType):
            held = vars(module).items()
            _loaded[name] = {key: value for key, value in held if callable(value)}


def replaced_code() -> str:
    """Name a function or class that is no longer the one that `watch_code` saw: ``numpy.hypot``;
    empty where none was replaced, or nobody watches.
    """
    for name, held in _loaded.items():
        present = vars(sys.modules[name]) if name in sys.modules else held
        for key, value in held.items():
            if present.get(key, value) is not value:
                return f"{name}.{key}"
    return ""
