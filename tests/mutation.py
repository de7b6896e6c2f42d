"""``python -m tests.mutation``: one change at a time in lines drawn at random, and whether the tests see it.

Nothing is changed in place: the tree is copied, and the tests run there. A change is killed by the first test file that
fails or hangs among those nearest to it: its mirror first, then those that reach it by the fewest imports. All lines
are drawn before any is tried. Findings go to a file line by line, and the same seed goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import ast
import copy
import difflib
import json
import os
import queue
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

REPOSITORY = Path(__file__).parents[1]
PACKAGES = ("arrays", "magloc", "adcs", "sims")
OPPOSITE: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Div,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.MatMult: ast.Mult,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
# Of numbers that count, 1 is at the edge; for all others only the opposite says something.
EDGE: dict[type[ast.AST], type[ast.AST]] = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
# How a figure looks, what a linter wants to be said, how an object is printed: no property that a test could hold.
LOOKS = re.compile(
    r"alpha|lw|ls|ms|mew|e?linewidths?|(font|label)size|(label|handletext|border)?pad|columnspacing|zorder|figsize|dpi|rotation"
    r"|aspect|shrink|frameon|rasterized|depthshade|arrow_length_ratio|bbox_to_anchor|xytext|arrowprops|(width|height)_ratios|opacity"
    r"|(cast|receive)_shadow|strict|repr|kw_only"
)
# A change of type, which counts only where types are told apart.
CONVERSION = re.compile(
    r"float|int|bool|str|tuple|list|set|frozenset|dict|iter|own|(np\.)?(as\w+|float64|int64)|[A-Z].*"
)
# Of a tolerance, a small power of ten, the order alone means something; so does that of a choice, which has a name.
TOLERANCE = 1e-4
# A hang: longer than this, and than some times what the file takes unchanged.
LONGEST_S, SLOWER = 60.0, 4.0
HANGS = "hangs"
UNTESTED = "untested"  # no test file reaches it, or none in time: no part of the score


class StoppedError(Exception):
    """The tests of a change were ended from outside: nothing is known of it."""


class Mutant(NamedTuple):
    """One change: what stands at some bytes of a file, and what is put there."""

    path: str
    line: int
    kind: str
    begin: int
    end: int
    text: str
    in_function: bool = True

    @property
    def name(self) -> str:
        """The same in every run."""
        return f"{self.path}:{self.line}:{self.begin}:{self.kind}:{self.text}"

    def applied(self, source: bytes) -> bytes:
        """The file with the change."""
        return source[: self.begin] + self.text.encode() + source[self.end :]

    def diff(self, source: bytes) -> str:
        """The lines that differ."""
        before, after = source.decode().splitlines(), self.applied(source).decode().splitlines()
        lines = list(difflib.unified_diff(before, after, self.path, self.path, lineterm="", n=1))
        return "\n".join(lines[1:])


def mutants(path: str, source: bytes) -> Iterator[Mutant]:
    """All changes of a file, but for words: docstrings, types, what an error or a log says, formatted text."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    tree = ast.parse(source)
    functions = [body for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) for body in node.body]
    inside = {node for body in functions for node in ast.walk(body)}
    for node, kind, new in _changes(tree, ast.Module(body=[], type_ignores=[])):
        begin, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
        text = new if isinstance(new, str) else f"({ast.unparse(new)})"
        yield Mutant(path, node.lineno, kind, begin, end, text, node in inside)


def _changes(node: ast.AST, parent: ast.AST) -> Iterator[tuple[Any, str, ast.AST | str]]:
    if isinstance(node, ast.JoinedStr | ast.Import | ast.ImportFrom) or _is_look(node):
        return
    if isinstance(node, ast.FunctionDef) and node.name in {"__repr__", "__str__"}:
        return
    if isinstance(node, ast.If) and ast.unparse(node.test) in {"TYPE_CHECKING", "__name__ == '__main__'"}:
        return
    if isinstance(node, ast.Assign) and isinstance(parent, ast.Module) and _is_type(node.value):
        return
    if isinstance(node, ast.AnnAssign) and ast.unparse(node.annotation) == "Colour":
        return
    chosen = isinstance(parent, ast.Assign | ast.AnnAssign | ast.arguments)
    yield from _changes_here(node, chosen)
    if isinstance(node, ast.Return) and isinstance(parent, ast.If):
        yield node, "return", "pass"
    for field, value in ast.iter_fields(node):
        if field in {"annotation", "returns", "decorator_list", "exc", "bases"}:
            continue
        if field in {"args", "keywords"} and isinstance(node, ast.Call) and _is_words(node):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _changes(child, node)


def _changes_here(node: ast.AST, chosen: bool) -> Iterator[tuple[Any, str, ast.AST | str]]:
    match node:
        case ast.Compare(ops=[op], comparators=[right]):
            yield node, "comparison", _with(node, ops=[OPPOSITE[type(op)]()])
            if type(op) in EDGE and (_counts(node.left) or _counts(right)):
                yield node, "edge", _with(node, ops=[EDGE[type(op)]()])
        case ast.BinOp(op=op) if type(op) in OPPOSITE:
            yield node, "operator", _with(node, op=OPPOSITE[type(op)]())
        case ast.BoolOp(op=op):
            yield node, "operator", _with(node, op=OPPOSITE[type(op)]())
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            yield node, "sign", operand
        case ast.Constant(value=bool() as value):
            yield node, "constant", repr(not value)
        case ast.Constant(value=int() as value):
            yield node, "constant", repr(value + 1 if value < 10 else 2 * value)
        case ast.Constant(value=float() as value):
            tolerance = value <= TOLERANCE and f"{value:e}".startswith("1.000000")
            yield node, "constant", repr((10.0 if tolerance or chosen else 1.01) * value if value else 1.0)
        case ast.If(test=test) | ast.IfExp(test=test) if isinstance(test, ast.Name | ast.Attribute | ast.Call):
            yield test, "condition", ast.UnaryOp(ast.Not(), test)
        case ast.AugAssign(op=op, target=target, value=value):
            yield node, "statement", "pass"
            if type(op) in OPPOSITE:
                yield node, "operator", ast.unparse(ast.AugAssign(target, OPPOSITE[type(op)](), value))
        case ast.Assign(targets=[ast.Subscript() | ast.Attribute()]):
            yield node, "statement", "pass"
        case ast.Expr(value=ast.Call() as call) if _is_words(call):
            return
        case ast.Raise() | ast.Continue() | ast.Break() | ast.Expr(value=ast.Call()):
            yield node, "statement", "pass"
        case ast.Subscript(slice=ast.Name() | ast.BinOp() as index, ctx=ast.Load()) if _is_index(node):
            yield index, "index", f"{ast.unparse(index)} - 1"
        case ast.Call(args=[ast.Name() | ast.BinOp() | ast.Call() | ast.Attribute() as one], keywords=[]) if not (
            _is_words(node) or CONVERSION.fullmatch(ast.unparse(node.func))
        ):
            yield node, "call", one
        case ast.Call(args=[first, second, *rest]) if not _is_words(node):
            if not isinstance(first, ast.Starred) and not isinstance(second, ast.Starred) and _differ(first, second):
                yield node, "arguments", _with(node, args=[second, first, *rest])


def _with(node: ast.AST, **fields: object) -> ast.AST:
    changed = copy.copy(node)
    for field, value in fields.items():
        setattr(changed, field, value)
    return changed


def _differ(first: ast.AST, second: ast.AST) -> bool:
    return ast.dump(first) != ast.dump(second)


def _counts(node: ast.AST) -> bool:
    """Whether a number is a count by its looks: a whole number, a size."""
    if isinstance(node, ast.Constant):
        return type(node.value) is int
    return bool(re.search(r"\b(len\(.*\)|size|ndim|shape\[\d\]|n_\w+)$", ast.unparse(node)))


def _is_look(node: ast.AST) -> bool:
    return isinstance(node, ast.keyword) and node.arg is not None and bool(LOOKS.fullmatch(node.arg))


def _is_index(node: ast.Subscript) -> bool:
    """Whether something is taken by its number, by the looks of that: a short name of no type, or a sum."""
    return bool(re.fullmatch(r"[i-n]|\w*(index|row)|.* [+-] .*", ast.unparse(node.slice)))


def _is_type(node: ast.AST) -> bool:
    """Whether a value at the top of a module looks like a type."""
    return bool(
        re.match(r"(Callable|dict|list|tuple|Literal|NDArray|Mapping|Sequence|\w+( \| \w+)+$)", ast.unparse(node))
    )


def _is_words(node: ast.Call) -> bool:
    """Whether a call only says something, names a type, or is a matter of looks."""
    return bool(
        re.match(
            r"(.*\.(grid|tick_params|margins|tight_layout|set_facecolor)$|_LOG\.|warnings\.warn|log\w*\.|cast$|TypeVar$|NewType$)",
            ast.unparse(node.func),
        )
    )


class Reach:
    """Which test files reach a module, by the fewest imports; a test file reaches its mirror at once."""

    def __init__(self) -> None:
        files = [path for folder in (*PACKAGES, "tests") for path in (REPOSITORY / folder).rglob("*.py")]
        self.modules = {".".join(path.relative_to(REPOSITORY).with_suffix("").parts): path for path in files}
        self.importers: dict[str, set[str]] = defaultdict(set)
        public = {
            f"{package}.{alias.asname}": f"{node.module}.{alias.name}"
            for package in PACKAGES
            for node in ast.parse((REPOSITORY / package / "__init__.pyi").read_text(encoding="utf-8")).body
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        for module, path in self.modules.items():
            for name in _names(module, ast.parse(path.read_text(encoding="utf-8"))):
                full = public.get(name, name)
                target = full if full in self.modules else full.rpartition(".")[0]
                if target in self.modules:
                    self.importers[target].add(module)

    def from_module(self, path: str) -> dict[str, int]:
        """All modules that import a file, themselves or by others, with how many imports that takes."""
        first = path.removesuffix(".py").replace("/", ".")
        found, last = {first: 0}, [first]
        while last:
            last = sorted({name for one in last for name in self.importers[one]} - found.keys())
            found |= dict.fromkeys(last, max(found.values()) + 1)
        return found

    def tests(self, path: str) -> list[str]:
        """Test files of a product file: its mirror, then by imports and by how much of the path is the same."""
        where = Path("tests", path).with_name(f"test_{Path(path).stem}.py")

        def near(module: str) -> tuple[bool, bool, int, int, str]:
            file = Path(*module.split(".")).with_suffix(".py")
            shared = sum(one == other for one, other in zip(file.parts, where.parts, strict=False))
            return file != where, file.name != where.name, distance[module], -shared, module

        distance = self.from_module(path)
        names = [name for name in distance if name.startswith("tests.") and name.rpartition(".")[2].startswith("test_")]
        return [str(self.modules[name].relative_to(REPOSITORY)) for name in sorted(names, key=near)]


def _names(module: str, tree: ast.Module) -> Iterator[str]:
    """Dotted names that a module may have of others: imported, or taken from a package's root."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (f"{alias.name}.x" for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            yield f"{node.value.id}.{node.attr}"
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and re.fullmatch(r"[\w.]+:\w+", node.value):
            yield node.value.replace(":", ".")  # as commands are registered
    if ".test_" in module:
        mirror = module.removeprefix("tests.").replace(".test_", ".")
        yield f"{mirror}.x"


class Laboratory:
    """A copy of the tree in which changes are tried."""

    def __init__(self, root: Path, unchanged: Path, reach: Reach, seconds: dict[str, float]) -> None:
        self.root, self.unchanged, self.reach, self.seconds = root, unchanged, reach, seconds
        self.process: subprocess.Popen[str] | None = None
        self.stopped = False
        copied(unchanged, root)

    def verdict(self, mutant: Mutant, most_files: int, most_s: float) -> str:
        """What killed a change; empty where it survives."""
        file = self.root / mutant.path
        source, times = file.read_bytes(), file.stat()
        left, tried = most_s, 0
        try:
            file.write_bytes(mutant.applied(source))
            for test in self.reach.tests(mutant.path)[:most_files]:
                if self.seconds.get(test, 0.0) >= left:
                    continue
                begin = time.monotonic()
                killed = self._run(self.root, test, max(LONGEST_S, SLOWER * self.seconds.get(test, 0.0)))
                took = time.monotonic() - begin
                left -= took
                if killed and self._unchanged(killed):
                    return killed
                if not killed:
                    self.seconds.setdefault(test, took)
                    tried += 1
        finally:
            file.write_bytes(source)
            os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
        return "" if tried else UNTESTED

    def stop(self) -> None:
        """End the tests that run."""
        self.stopped = True
        if self.process and self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)

    def _unchanged(self, killed: str) -> bool:
        """Whether what failed does not fail in the tree as it is, nor takes as long."""
        test = killed.removesuffix(f": {HANGS}")
        if test not in self.seconds:
            begin = time.monotonic()
            failed = self._run(self.unchanged, test.partition(": status")[0], LONGEST_S)
            fails = failed and not failed.endswith(HANGS)
            self.seconds[test] = float("inf") if fails else time.monotonic() - begin
        return self.seconds[test] < (LONGEST_S / SLOWER if killed.endswith(HANGS) else float("inf"))

    def _run(self, root: Path, test: str, most_s: float) -> str:
        """What fails first in a test file, or that it hangs; empty where all is well."""
        if self.stopped:
            raise StoppedError
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", test]
        variables = os.environ | {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
        pipe = subprocess.PIPE
        with subprocess.Popen(
            command, cwd=root, env=variables, stdout=pipe, stderr=pipe, text=True, start_new_session=True
        ) as self.process:
            try:
                out, _ = self.process.communicate(timeout=most_s)
            except subprocess.TimeoutExpired:
                return f"{test}: {HANGS}"
            finally:
                if self.process.poll() is None:
                    os.killpg(self.process.pid, signal.SIGKILL)
        if self.stopped:
            raise StoppedError
        if self.process.returncode in {0, 5}:  # 5: all of its tests are slow
            return ""
        failed = re.search(r"^(?:FAILED|ERROR) ([^\s[]+)", out, re.MULTILINE)
        return failed[1] if failed else f"{test}: status {self.process.returncode}"


def copied(tree: Path, place: Path) -> None:
    """The tree as it is."""
    left_out = shutil.ignore_patterns(".git", ".venv*", ".artefacts", "_build", ".*_cache")
    shutil.copytree(tree, place, ignore=left_out)


def drawn(n_lines: int, seed: int, packages: tuple[str, ...]) -> list[Mutant]:
    """One change in each of some lines, all lines that can be changed being as likely."""
    lines: dict[tuple[str, int], list[Mutant]] = defaultdict(list)
    for package in packages:
        for path in sorted((REPOSITORY / package).rglob("*.py")):
            name = str(path.relative_to(REPOSITORY))
            for mutant in mutants(name, path.read_bytes()):
                lines[name, mutant.line].append(mutant)
    rng = random.Random(seed)
    return [rng.choice(lines[line]) for line in rng.sample(sorted(lines), min(n_lines, len(lines)))]


def table(found: list[dict[str, str]], n_drawn: int) -> str:
    """Score of every package and kind, and the diff of every survivor."""
    tried = [one for one in found if one["killed"] != UNTESTED]
    lines = [f"{one['diff']}\n" for one in tried if not one["killed"]]
    for by in ("package", "kind"):
        total = Counter(one[by] for one in tried)
        killed = Counter(one[by] for one in tried if one["killed"])
        lines += [f"{name:12s}{killed[name]:5d} of {n:4d} killed" for name, n in sorted(total.items())]
    n_killed = sum(bool(one["killed"]) for one in tried)
    n_hang = sum(one["killed"].endswith(HANGS) for one in tried)
    lines += [
        f"{n_killed} of {len(tried)} killed, {100.0 * n_killed / max(len(tried), 1):.1f} %, {n_hang} of them by a hang",
        f"{len(found) - len(tried)} that no test file reaches in time, {n_drawn - len(found)} of {n_drawn} left to try",
    ]
    return "\n".join(lines)


def main() -> int:
    """Draw, try, and say what survives."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("--count", type=int, default=300, help="lines to draw")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="changes at a time, each in a copy of its own")
    parser.add_argument("--package", choices=PACKAGES, action="append")
    parser.add_argument("--files", type=int, default=6, help="test files at most for a change")
    parser.add_argument("--limit-s", type=float, default=180.0, help="seconds at most that these take unchanged")
    parser.add_argument("--out", type=Path, help="where the results go (default .artefacts/mutation-SEED.jsonl)")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # and leave nothing behind
    out = arguments.out or REPOSITORY / ".artefacts" / f"mutation-{arguments.seed}.jsonl"
    out.parent.mkdir(parents=True, exist_ok=True)
    lines = out.read_text(encoding="utf-8").splitlines() if out.exists() else []
    known = {one["name"]: one for one in map(json.loads, lines)}
    chosen = drawn(arguments.count, arguments.seed, tuple(arguments.package or PACKAGES))
    lock, free = threading.Lock(), queue.SimpleQueue[Laboratory]()
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder, out.open("a", encoding="utf-8") as stream:
        unchanged, reach, seconds = Path(folder, "unchanged"), Reach(), dict[str, float]()
        copied(REPOSITORY, unchanged)
        laboratories = [Laboratory(Path(folder, str(i)), unchanged, reach, seconds) for i in range(arguments.jobs)]
        for laboratory in laboratories:
            free.put(laboratory)

        def tried(mutant: Mutant) -> None:
            laboratory = free.get()
            try:
                killed = laboratory.verdict(mutant, arguments.files, arguments.limit_s)
            finally:
                free.put(laboratory)
            package, diff = mutant.path.partition("/")[0], mutant.diff((unchanged / mutant.path).read_bytes())
            one = {"name": mutant.name, "package": package, "kind": mutant.kind, "killed": killed, "diff": diff}
            with lock:
                print(json.dumps(one, ensure_ascii=False), file=stream, flush=True)
                print(f"{mutant.path}:{mutant.line} {mutant.kind}: {killed or 'SURVIVES'}", flush=True)
                known[mutant.name] = one

        with ThreadPoolExecutor(arguments.jobs) as pool:
            left = [mutant for mutant in chosen if mutant.name not in known]
            futures = [pool.submit(tried, mutant) for mutant in left]
            try:
                for future in futures:
                    future.result()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
                for laboratory in laboratories:
                    laboratory.stop()
    print(table([known[mutant.name] for mutant in chosen if mutant.name in known], len(chosen)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
