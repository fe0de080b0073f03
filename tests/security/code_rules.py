"""What our own code must not do, read off its syntax trees."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

_UNPICKLING = frozenset(
    {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "jsonpickle", "pickletools"}
)
_SHELLS = frozenset({"os.system", "os.popen", "subprocess.getoutput", "subprocess.getstatusoutput", "pty.spawn"})
_RUNNERS = frozenset(
    {"subprocess.run", "subprocess.Popen", "subprocess.call", "subprocess.check_call", "subprocess.check_output"}
)
_SHELL_PROGRAMS = frozenset({"sh", "bash", "dash", "zsh", "cmd", "cmd.exe", "powershell", "/bin/sh", "/bin/bash"})
_MAY_OPEN_MEDIA = ("ahoy_core/formats/video_open.py", "ahoy_core/formats/video_write.py", "benchmarks/")


def broken_rules(source: str, path: str = "example.py") -> list[str]:
    """Sentences `LINE: what is wrong` for one module.

    Args:
        source: its text.
        path: relative to the repository, with `/`; some rules have places that they do not hold for.
    """
    tree = ast.parse(source)
    names = _imported_names(tree)
    found = [f"{node.lineno}: {why}" for node in ast.walk(tree) for why in _of_import(node)]
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = _dotted(node.func, names)
            found += [f"{node.lineno}: {why}" for why in (*_of_call(node, called), *_of_place(called, path))]
        if isinstance(node, ast.FunctionDef) and node.name in ("__reduce__", "__reduce_ex__"):
            found.append(f"{node.lineno}: {node.name} is pickling's")
    return found


def modules(root: Path, packages: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Path (relative, with `/`) and text of every module of our packages."""
    for package in packages:
        for path in sorted((root / package).rglob("*.py")):
            yield path.relative_to(root).as_posix(), path.read_text(encoding="utf-8")


def _of_import(node: ast.AST) -> Iterator[str]:
    found: list[str] = []
    if isinstance(node, ast.Import):
        found = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom) and node.module:
        found = [node.module]
    for name in found:
        if name.split(".")[0] in _UNPICKLING:
            yield f"imports {name}: pickles run code when they are read"


def _of_call(call: ast.Call, called: str) -> Iterator[str]:
    keywords = {keyword.arg: keyword.value for keyword in call.keywords if keyword.arg}
    if called in ("eval", "exec", "builtins.eval", "builtins.exec"):
        yield f"{called} runs text as code"
    if called == "torch.load" and not _is(keywords.get("weights_only"), True):
        yield "torch.load without weights_only=True unpickles"
    if "allow_pickle" in keywords and not _is(keywords["allow_pickle"], False):
        yield "allow_pickle reads or writes pickles"
    if called.endswith(("read_pickle", "to_pickle")):
        yield f"{called} is pickling's"
    if called == "yaml.load" or called.endswith(("yaml.unsafe_load", "yaml.full_load")):
        yield f"{called} makes arbitrary objects: use yaml.safe_load"
    if _is(keywords.get("persist_result"), True) or _is(keywords.get("result_serializer"), "pickle"):
        yield "Prefect would pickle the result"
    if called in _SHELLS or "create_subprocess_shell" in called:
        yield f"{called} gives text to a shell"
    if "shell" in keywords and not _is(keywords["shell"], False):
        yield "shell= gives text to a shell"
    if called in _RUNNERS:
        yield from _of_command(call.args[0] if call.args else keywords.get("args"))
    if called == "tempfile.mktemp":
        yield "tempfile.mktemp gives a name that somebody else may take first"
    if called.endswith(".extractall") and not _is(keywords.get("filter"), "data"):
        yield "extractall writes wherever the archive says"
    if called == "jinja2.Environment" and "autoescape" not in keywords:
        yield "jinja2.Environment without autoescape"


def _of_command(command: ast.expr | None) -> Iterator[str]:
    if isinstance(command, (ast.JoinedStr, ast.BinOp)) and not isinstance(getattr(command, "left", None), ast.List):
        yield "a command put together as one text"
    if isinstance(command, ast.Constant) and isinstance(command.value, str):
        yield "a command as one text: give a list of arguments"
    if isinstance(command, ast.List) and command.elts and _is_any(command.elts[0], _SHELL_PROGRAMS):
        yield "a shell as the program"


def _of_place(called: str, path: str) -> Iterator[str]:
    if called in ("av.open", "cv2.VideoCapture", "cv2.VideoWriter") and not path.startswith(_MAY_OPEN_MEDIA):
        yield f"{called} outside {', '.join(_MAY_OPEN_MEDIA)}: nothing guards what the file leads to"


def _imported_names(tree: ast.AST) -> dict[str, str]:
    """What each imported name stands for: `np` -> `numpy`, `Popen` -> `subprocess.Popen`."""
    names: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.asname: alias.name for alias in node.names if alias.asname}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    return names


def _dotted(node: ast.expr, names: dict[str, str]) -> str:
    if isinstance(node, ast.Name):
        return names.get(node.id, node.id)
    if isinstance(node, ast.Attribute):
        return f"{_dotted(node.value, names)}.{node.attr}"
    return ""


def _is(node: ast.expr | None, value: object) -> bool:
    return isinstance(node, ast.Constant) and node.value == value and type(node.value) is type(value)


def _is_any(node: ast.expr, values: frozenset[str]) -> bool:
    return isinstance(node, ast.Constant) and node.value in values
