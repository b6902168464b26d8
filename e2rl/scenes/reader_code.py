"""The code of a data source: the modules that its class comes from, and what a user's
ones import from beside them.

The cache of scenes is keyed by it, so that an edited reader does not get the scenes of
the old one; and messages name the line of it that failed.
"""

import ast
import hashlib
import sys
from collections.abc import Iterator
from importlib.machinery import PathFinder
from importlib.util import resolve_name
from pathlib import Path
from types import TracebackType

PACKAGE = "e2rl"
INSTALLED = {"site-packages", "dist-packages"}  # folders of libraries


def code_hash(kind: type) -> str | None:
    """Returns the SHA-256 of a class's code; None where it is in no file, as in an
    interactive session.

    Of the package's own modules it holds those in which the class and its bases are
    defined: what these call is covered by the version of the scene builder. Of others
    it also holds all that they import, at whatever depth, from the folder in which
    their top-level module or package lies.

    Args:
        kind: a class; its bases from the standard library do not count.
    """
    files: dict[str, Path | None] = {}
    for name in _modules(kind):
        files[name] = _loaded_file(name)
        if not _is_own(name):
            files |= _imported_files(name, files[name])
    digest = hashlib.sha256()
    for name, file in sorted(files.items()):
        if file is None or not file.is_file():
            return None
        digest.update(name.encode() + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def failed_line(kind: type, trace: TracebackType | None) -> str:
    """Returns "file:line" of the last call of a traceback that is in a user's code; ""
    where there is none.

    Args:
        kind: the class that was called, to whose folder the code belongs.
        trace: of the exception.
    """
    names = [name for name in _modules(kind) if not _is_own(name)]
    files = {name: file for name in names if (file := _loaded_file(name))}
    folders = [_folder(name, file) for name, file in files.items()]
    paths = set(map(str, files.values()))
    line = ""
    while trace is not None:
        code = trace.tb_frame.f_code.co_filename
        module = trace.tb_frame.f_globals.get("__name__", "")
        beside = any(_is_inside(Path(code), folder) for folder in folders)
        interactive = code.startswith("<") and not _is_standard(module)
        if code in paths or ((beside or interactive) and not _is_own(module)):
            line = f"{code}:{trace.tb_lineno}"
        trace = trace.tb_next
    return line


def _modules(kind: type) -> list[str]:
    """Returns the modules that define a class and its bases, without the standard
    library's."""
    names = dict.fromkeys(base.__module__ for base in kind.__mro__)
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
    """Returns the folder in which the top-level module or package of a module lies; of
    a library, the package."""
    depth = module.count(".") + (file.name == "__init__.py")
    folder = file.parents[depth]
    return file.parents[max(depth - 1, 0)] if folder.name in INSTALLED else folder


def _imported_files(module: str, file: Path | None) -> dict[str, Path | None]:
    """Returns the files, by module, that a module imports from its folder, and what
    these import from it."""
    if file is None:
        return {}
    folder = _folder(module, file)
    files: dict[str, Path | None] = {module: file}
    waiting = [(module, file)]
    while waiting:
        name, path = waiting.pop()
        if path.suffix != ".py":
            continue
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        for imported, place in _located(_imports(path, package)):
            inside = _is_inside(place, folder) and not _is_own(imported)
            if inside and imported not in files:
                files[imported] = place
                waiting.append((imported, place))
    return files


def _imports(file: Path, package: str) -> Iterator[str]:
    """Yields the dotted names that a file may import, from anywhere in it; none of one
    that is no Python.

    A relative import that leads out of its package is none: files that catch its error
    name another.
    """
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):  # whoever imports it may catch that
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            try:
                name = resolve_name(base, package) if node.level else base
            except ImportError:
                continue
            yield from (name, *(f"{name}.{alias.name}" for alias in node.names))


def _located(names: Iterator[str]) -> Iterator[tuple[str, Path]]:
    """Yields the modules that dotted names stand for, with the packages around them,
    and their files."""
    for name in names:
        if _is_standard(name):
            continue
        parts = name.split(".")
        folders = None
        for depth in range(len(parts)):
            part = ".".join(parts[: depth + 1])
            loaded = getattr(sys.modules.get(part), "__spec__", None)
            spec = loaded or PathFinder.find_spec(part, folders)
            if spec is None:
                break
            if spec.has_location and spec.origin:
                yield spec.name, Path(spec.origin).resolve()
            folders = spec.submodule_search_locations
            if folders is None:
                break
