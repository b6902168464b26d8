"""The code of a data source: the modules that its class comes from, and what lies
beside those of a user.

The cache of scenes is keyed by it, so that an edited reader does not get the scenes of
the old one; and messages name the line of it that failed.
"""

import hashlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

PACKAGE = "e2rl"
INSTALLED = {"site-packages", "dist-packages"}  # folders of libraries


def code_hash(kind: type) -> str | None:
    """Returns the SHA-256 of a class's code; None where it is in no file, as in an
    interactive session.

    Of the package's own modules it holds those in which the class and its bases are
    defined: what these call is covered by the version of the scene builder. Of others
    it also holds all Python files of their package, or those beside a lone module.

    Args:
        kind: a class; its bases from the standard library do not count.
    """
    files: set[Path] = set()
    for module in _modules(kind):
        file = _loaded_file(module)
        if file is None or not file.is_file():
            return None
        files.add(file)
        if not _is_own(module):
            files.update(_folder(module, file).glob(_pattern(module)))
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(file.name.encode() + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def failed_line(kind: Callable, trace: TracebackType | None) -> str:
    """Returns "file:line" of the last call of a traceback that is in a user's code; ""
    where there is none.

    Args:
        kind: the class or function that was called, to whose folder the code belongs.
        trace: of the exception.
    """
    names = [name for name in _modules(kind) if not _is_own(name)]
    files = {name: file for name in names if (file := _loaded_file(name))}
    folders = [_folder(name, file) for name, file in files.items()]
    line = ""
    while trace is not None:
        code = trace.tb_frame.f_code.co_filename
        module = trace.tb_frame.f_globals.get("__name__", "")
        interactive = code.startswith("<") and not _is_standard(module)
        beside = any(_is_inside(Path(code), folder) for folder in folders)
        if (beside or interactive) and not _is_own(module):
            line = f"{code}:{trace.tb_lineno}"
        trace = trace.tb_next
    return line


def _modules(kind: Callable) -> list[str]:
    """Returns the modules that define a function, or a class and its bases, without the
    standard library's."""
    bases = kind.__mro__ if isinstance(kind, type) else (kind,)
    names = dict.fromkeys(base.__module__ for base in bases)
    return [name for name in names if not _is_standard(name)]


def _is_own(module: str) -> bool:
    return module.partition(".")[0] == PACKAGE


def _is_standard(module: str) -> bool:
    return module.partition(".")[0] in sys.stdlib_module_names and module != "__main__"


def _is_inside(path: Path, folder: Path) -> bool:
    """Returns whether a file lies below a folder, and in no library installed there."""
    if not path.is_relative_to(folder):
        return False
    return INSTALLED.isdisjoint(path.relative_to(folder).parts)


def _loaded_file(module: str) -> Path | None:
    """Returns the file of a module that is imported."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file).resolve() if file else None


def _folder(module: str, file: Path) -> Path:
    """Returns the folder of a module's top-level package, or of a lone module."""
    depth = module.count(".") + (file.name == "__init__.py")
    return file.parents[max(depth - 1, 0)]


def _pattern(module: str) -> str:
    """Returns which files of that folder belong to a module."""
    is_package = hasattr(sys.modules[module.partition(".")[0]], "__path__")
    return "**/*.py" if is_package else "*.py"
