"""What would fail on Windows or macOS alone: found by reading the code, and by taking away what they lack."""

from __future__ import annotations

import ast
import importlib
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

from magloc.grids import store
from tests.conftest import REPOSITORY
from tests.test_house import FILES, PACKAGES
from tests.waiting import WAIT_S

# Of the standard library, what Windows (or any system but it) has not.
ELSEWHERE = frozenset("fcntl grp msvcrt posix pty pwd readline resource syslog termios tty winreg winsound".split())  # noqa: SIM905
UNIX_ALONE = re.compile(
    r"os\.(fork\w*|get\w*[ug]id|set\w*[ug]id|setsid|kill\w*|wait(pid)?|uname|f?chown|mkfifo|statvfs|getloadavg|sched_\w+"
    r"|openpty|O_(NOFOLLOW|DIRECTORY|NONBLOCK|CLOEXEC)|WIF\w+)"
    r"|signal\.(SIG(KILL|HUP|PIPE|ALRM|CHLD|USR[12]|QUIT|STOP|CONT|WINCH)|alarm|pause|setitimer|sig\w*wait\w*|pthread_\w+)"
)
OPENING = frozenset(
    [
        "open",
        "fdopen",
        "read_text",
        "write_text",
        "NamedTemporaryFile",
        "TemporaryFile",
        "TextIOWrapper",
        "Popen",
        "run",
    ]
)
# Functions of our own that have the names of methods, and what opens something else than a text file.
NO_FILES = frozenset(
    ["read_text", "write_text", "os.open", "webbrowser.open", "Image.open", "rasterio.open", "self.open", "direct.open"]
)


def text_without_encoding(call: ast.Call) -> bool:
    """Whether it reads or writes text as the machine has it: no encoding, or no end of line where it writes."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    if name not in OPENING or (whole := ast.unparse(call.func)) in NO_FILES:
        return False
    if any(keyword.arg == "driver" for keyword in call.keywords):  # a raster
        return False
    keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
    if name in {"run", "Popen"}:
        return whole.startswith("subprocess.") and bool(keywords.keys() & {"text", "universal_newlines"})
    modes = [ast.literal_eval(keywords.get("mode", "''"))]
    modes += [
        one.value for one in call.args if isinstance(one, ast.Constant) and re.fullmatch("[rwaxbt+]+", str(one.value))
    ]
    default = "w+b" if name.endswith("TemporaryFile") else "w" if name == "write_text" else "r"
    mode = next((mode for mode in modes if mode), default)
    if "b" in mode:
        return False
    writes = bool(set(mode) & set("wax+"))
    nowhere = bool(call.args) and ast.unparse(call.args[0]) == "os.devnull"
    ends = nowhere or not writes or "newline" in keywords
    return keywords.get("encoding") not in {"'utf-8'", "'utf-8-sig'"} or not ends


def paths_as_text(node: ast.AST) -> bool:
    """Whether it puts a path together as one system writes it, or names a place of one."""
    if isinstance(node, ast.Attribute):
        last = node.attr in {"sep", "altsep", "pathsep", "join"}  # to write each of them out takes seconds
        return last and bool(re.fullmatch(r"os\.(sep|altsep|pathsep|path\.(join|sep))", ast.unparse(node)))
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return bool(re.match(r"(/(tmp|dev|proc|etc|usr|var|home|root|Users)\b|[A-Za-z]:\\|~/)", node.value))
    if isinstance(node, ast.Call) and ast.unparse(node.func) in {"Path", "open", "os.open", "os.replace"}:
        texts = [one.value for given in node.args for one in ast.walk(given) if isinstance(one, ast.Constant)]
        return any(isinstance(text, str) and re.search(r"[/\\]", text) for text in texts)
    return False


def asks_for_the_system(node: ast.AST) -> bool:
    """Whether it is `sys.platform`, or asks what `os` or `signal` has."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "hasattr":
        return ast.unparse(node.args[0]) in {"os", "signal"}
    return isinstance(node, ast.Attribute) and node.attr == "platform" and ast.unparse(node.value) == "sys"


def unguarded(tree: ast.Module) -> Iterator[ast.AST]:
    """Modules and names that not every system has, outside of a function that asks which one it is."""
    asked: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and any(asks_for_the_system(part) for part in ast.walk(node)):
            asked |= set(ast.walk(node))
    for node in set(ast.walk(tree)) - asked:
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        if isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module, *(f"{node.module}.{name}" for name in names)]
        if set(names) & ELSEWHERE or any(UNIX_ALONE.fullmatch(name) for name in names):
            yield node
        of_module = isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
        if of_module and UNIX_ALONE.fullmatch(f"{node.value.id}.{node.attr}"):
            yield node


def _calls(tree: ast.Module) -> Iterator[ast.AST]:
    return (node for node in ast.walk(tree) if isinstance(node, ast.Call) and text_without_encoding(node))


def _paths(tree: ast.Module) -> Iterator[ast.AST]:
    return (node for node in ast.walk(tree) if paths_as_text(node))


RULES: dict[str, tuple[Callable[[ast.Module], Iterator[ast.AST]], list[str], list[str]]] = {
    "text has an encoding": (
        _calls,
        [
            "open(path)",
            "open(path, 'w', encoding='utf-8')",
            "path.open('a', encoding='utf-8')",
            "path.read_text()",
            "path.write_text(text, encoding='utf-8')",
            "path.open(encoding='latin-1')",
            "tempfile.NamedTemporaryFile('w')",
            "subprocess.run(command, text=True)",
        ],
        [
            "open(path, 'rb')",
            "open(path, mode='wb')",
            "path.open(encoding='utf-8')",
            "path.write_text(text, encoding='utf-8', newline='')",
            "tempfile.NamedTemporaryFile(dir=folder)",
            "write_text(text, path)",
            "subprocess.run(command)",
        ],
    ),
    "paths are no text": (
        _paths,
        [
            "os.path.join(a, b)",
            "a + os.sep + b",
            "Path('/tmp')",
            "x = '/dev/null'",
            "Path(f'{a}/{b}')",
            "open(a + '/b')",
        ],
        ["Path(a, b)", "a / b", "f'{angle:.1f} °/s'", "os.devnull"],
    ),
    "a system is asked for what it lacks": (
        unguarded,
        [
            "import fcntl",
            "from os import fork",
            "def f():\n    os.killpg(1, 2)",
            "signal.SIGKILL",
            "def f():\n    import pwd",
        ],
        [
            "def f():\n    if sys.platform == 'win32': return\n    import fcntl",
            "def f():\n    return hasattr(os, 'geteuid') and os.geteuid()",
            "signal.SIGTERM",
            "import os",
        ],
    ),
}


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("rule", RULES)
class TestRules:
    def test_hold(self, rule: str) -> None:
        found = [
            f"{path.relative_to(REPOSITORY).as_posix()}:{node.lineno}: {ast.unparse(node)[:80]}"
            for path in FILES
            for node in RULES[rule][0](tree_of(path))
        ]
        assert found == []

    def test_what_breaks_them_is_found(self, rule: str) -> None:
        broken, kept = ([code for code in codes if list(RULES[rule][0](ast.parse(code)))] for codes in RULES[rule][1:])
        assert (broken, kept) == (RULES[rule][1], [])


def names() -> list[str]:
    """All files of the tree, but for what is made from them."""
    made = re.compile(
        r"\.(?!github)|kernels\.(so|dll)$|_declarations\.py$|_build$|__pycache__$|build$|dist$|.*\.egg-info$|map-"
    )
    made_pages = {
        Path(REPOSITORY, "docs", *place)
        for place in (
            ("reference", "names"),
            ("reference", "commands"),
            ("reference", "headers"),
            ("gallery", "notebooks"),
        )
    }
    found = []
    for folder, folders, files in os.walk(REPOSITORY):
        folders[:] = [name for name in folders if not made.match(name) and Path(folder, name) not in made_pages]
        found += [Path(folder, name).relative_to(REPOSITORY).as_posix() for name in files if not made.match(name)]
    return found


def twice(names: list[str]) -> list[str]:
    """Those that differ by case alone."""
    return [name for name, n in Counter(name.lower() for name in names).items() if n > 1]


class TestNamesOfFiles:
    def test_differ_by_more_than_case(self) -> None:
        assert twice(["a/B.py", "a/b.py", "c.py"]) == ["a/b.py"]
        assert twice(names()) == []

    def test_of_the_pages_of_names_differ_by_more_than_case(self) -> None:
        conf = ast.parse(Path(REPOSITORY, "docs", "conf.py").read_text(encoding="utf-8"))
        for_names = [
            ast.literal_eval(node.value)
            for node in conf.body
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "autosummary_filename_map"
        ]
        public = [f"{package}.{name}" for package in PACKAGES for name in importlib.import_module(package).__all__]
        assert twice([for_names[0].get(name, name) for name in public]) == []

    def test_are_names_on_every_system(self) -> None:
        device = re.compile(r"(.*/)?(con|aux|nul|prn|com\d|lpt\d)(\.[^/]*)?(/.*)?", re.IGNORECASE)
        assert device.fullmatch("a/nul.txt")
        assert [name for name in names() if device.fullmatch(name) or re.search(r'[<>:"|?*\\]|[. ](/|$)', name)] == []

    def test_leave_room_for_the_folder_that_they_are_put_in(self) -> None:
        assert max(map(len, names())) < 120  # of 260 on Windows


class TestWithoutUnix:
    @pytest.mark.slow
    def test_every_module_can_be_imported(self) -> None:
        files = [path.relative_to(REPOSITORY).with_suffix("") for path in FILES if path.stem != "__main__"]
        modules = [".".join(file.parts) for file in files]
        code = f"""
import importlib, sys
sys.modules.update(dict.fromkeys({sorted(ELSEWHERE - {"posix"})}))
for name in {modules}:
    importlib.import_module(name)
"""
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=WAIT_S, check=False)
        assert (done.returncode, done.stderr) == (0, "")

    def test_a_map_is_not_locked(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(sys, "platform", "win32")
        monkeypatch.setitem(sys.modules, "fcntl", None)
        assert store._locked(tmp_path) is None

    @pytest.mark.parametrize("encoding", ["cp1252", "ascii"])
    @pytest.mark.parametrize("arguments", [["locate", "--help"], ["new-array", "--help"], ["wrong", "χ²"]])
    def test_what_an_output_cannot_show_is_written_otherwise(self, encoding: str, arguments: list[str]) -> None:
        command = [sys.executable, "-m", "magloc.cli", *arguments]
        variables = os.environ | {"PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"}
        done = subprocess.run(command, env=variables, capture_output=True, timeout=WAIT_S, check=False)
        assert done.returncode == (2 if "wrong" in arguments else 0)
        assert b"Traceback" not in done.stderr
        assert (done.stderr if "wrong" in arguments else done.stdout).decode(encoding)

    def test_standard_input_is_utf_8(self) -> None:
        code = (
            "import sys; from magloc.cli.framework import run; from cyclopts import App; app = App(name='magloc')\n"
            "app.command(lambda: print(ascii(sys.stdin.readline())), name='read'); run(app, ['read'])"
        )
        variables = os.environ | {"PYTHONIOENCODING": "cp1252", "PYTHONUTF8": "0"}
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=variables,
            input="µT".encode(),
            capture_output=True,
            timeout=WAIT_S,
            check=True,
        )
        assert done.stdout.split() == [rb"'\xb5T'"]
