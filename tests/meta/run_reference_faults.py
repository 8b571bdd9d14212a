# SPDX-License-Identifier: MIT
"""``make faults``: whether ``tests/ref`` finds a fault at each branch, constant and operator of the reference.

The judge compares ports with the reference, so no port finds a fault of the reference: its own tests must. Faults are made from the source,
one at a time. All tests but those that need reference data are collected once; a fork has one fault and runs them until one fails.

``python -m tests.meta.run_reference_faults rrm frame`` does these modules alone.
"""

import ast
import copy
import importlib
import inspect
import os
import signal
import sys
from pathlib import Path
from time import perf_counter, process_time

import pytest
from _pytest.runner import runtestprotocol

ROOT = Path(__file__).parents[2]
MODULES = tuple(sorted({path.stem for path in (ROOT / "stss_ref").glob("*.py")} - {"__init__", "weights"}))
"""The modules that compute; ``weights`` is a table that the network's shapes check."""
SAME = {
    "accumulate: np.arange(length) + step -> np.arange(length) - step": "the steps are as many either way",
    "arrays: strict=True -> strict=False": "the lengths were compared before",
    "conv: 2 * r -> 3 * r": "more zeros, which nothing reads",
    "conv: 2 ** 15 -> 2 * 15": "fewer rows at a time",
    "conv: 2 ** 15 -> 2 ** 16": "more rows at a time",
    "conv: 2 ** 15 -> 3 ** 15": "likewise",
    "conv: IN_CACHE // (columns * outputs) -> IN_CACHE * (columns * outputs)": "all rows at a time",
    "conv: max(1, IN_CACHE // (columns * outputs)) -> max(2, IN_CACHE // (columns * outputs))": "two rows at a time, or more",
    "conv: x >= 0 -> x > 0": "at 0 both are 1 / 2",
    "depth: depth.dtype.type(1) -> depth.dtype.type(2)": "clipped it is 1, and scaled 0",
    "erm: strict=True -> strict=False": "both windows have 25 places",
    "frame: :3 -> :4": "a luma is of three channels",
    "frame: 6:9 -> 6:10": "a G-buffer has nine channels",
    "frame: strict=True -> strict=False": "the lists have one length",
    "holes: apart < np.inf -> apart <= np.inf": "an infinite distance becomes an infinite one",
    "loss: max(masked.sum(), 1e-06) -> max(masked.sum(), 1.2499999999999999e-06)": "a mask is of 0 and 1",
    "occlusion_warp: -1 -> -2": "any negative length is the one that follows",
    "resample: -1 -> -2": "any negative length is the one that follows",
    "resample: n - 1 -> n + 1": "beyond the last pixel both neighbours are it",
    "reshade: FOOTPRINTS ** 2 -> FOOTPRINTS * 2": "it is 2",
    "reshade: -1 -> 1": "arrays of N vectors have two axes",
    "reshade: strict=True -> strict=False": "a colour for each weight",
    "reshade: 1 / (square * square) -> 2 / (square * square)": "a factor of all weights cancels",
    "sample: -width - 1 -> -width - 2": "farther outside is as good",
    "sample: -height - 1 -> -height - 2": "likewise",
    "sample: width + 1 -> width + 2": "likewise",
    "sample: height + 1 -> height + 2": "likewise",
    "rrm: height * width // (16 * h) -> height * width * (16 * h)": "the area does not limit w: h <= H / 4, so H W / (16 h) >= W / 4",
    "rrm: 16 * h -> 16 / h": "likewise",
    "schedule: 5 -> 6": "no step is longer than 5",
}
"""A fault that no test can find -> why it is the same function."""
SWAPPED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
"""Each operator, and what stands in its place."""
LONGEST = 60
"""Seconds of processor time for the tests of one fault; what is not through then hangs, which is a way to be found."""


def places(tree):
    """(parent, field, index) of every expression that is computed: not in annotations, decorators, messages, and not a docstring."""
    stack = [tree]
    while stack:
        node = stack.pop()
        for field, value in ast.iter_fields(node):
            if field in ("annotation", "returns", "decorator_list") or isinstance(node, (ast.Raise, ast.JoinedStr)):
                continue
            for index, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
                if isinstance(child, ast.AST) and not (isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)):
                    stack.append(child)
                    yield node, field, index, child


def wrong(node, field):
    """What may stand in the place of an expression, by a word."""
    if isinstance(node, ast.Constant) and isinstance(node.value, (bool, int, float)):
        value = node.value
        changed = (not value) if isinstance(value, bool) else value + 1 if isinstance(value, int) else value * 1.25 or 1.0
        yield "", ast.Constant(changed)
    if isinstance(node, ast.Compare):
        for i, operator in enumerate(node.ops):
            other = copy.copy(node)
            other.ops = [*node.ops[:i], SWAPPED[type(operator)](), *node.ops[i + 1 :]]
            yield "", other
    if isinstance(node, (ast.BinOp, ast.BoolOp)) and type(node.op) in SWAPPED:
        other = copy.copy(node)
        other.op = SWAPPED[type(node.op)]()
        yield "", other
    if isinstance(node, ast.AugAssign):
        yield "", ast.AugAssign(node.target, SWAPPED[type(node.op)](), node.value)
    if isinstance(node, ast.UnaryOp):
        yield "", node.operand
    if field in ("test", "ifs"):
        yield "always", ast.Constant(True)
        yield "never", ast.Constant(False)


def faults(module):
    """(name, source, function) of each fault of a module; outside functions the name of none."""
    text = (ROOT / "stss_ref" / f"{module}.py").read_text(encoding="utf-8")
    tree = ast.parse(text)
    functions = {line: f.name for f in tree.body if isinstance(f, ast.FunctionDef) for line in range(f.lineno, f.end_lineno + 1)}
    for parent, field, index, node in places(tree):
        for word, other in wrong(node, field):
            whole = node if not isinstance(node, ast.Constant) or isinstance(parent, (ast.arguments, ast.Tuple)) else parent
            before = ast.unparse(whole)
            put(parent, field, index, ast.copy_location(other, node))
            source = ast.unparse(ast.fix_missing_locations(tree))
            after = word if word in ("always", "never") else ast.unparse(other if whole is node else parent)
            put(parent, field, index, node)
            name = f"{module}: {before} -> {after}".replace("\n", " ")
            yield f"{name}, line {node.lineno}:{node.col_offset}", source, functions.get(node.lineno)


def put(parent, field, index, node):
    if index is None:
        setattr(parent, field, node)
    else:
        getattr(parent, field)[index] = node


def plant(module, source):
    """Change a module that is imported already, and whatever took a name of it: code and defaults of functions, and constants."""
    right = importlib.import_module(f"stss_ref.{module}")
    wrong = {"__name__": right.__name__}
    exec(compile(source, right.__file__, "exec", dont_inherit=True), wrong)
    for name, value in wrong.items():
        old = vars(right).get(name)
        if inspect.isfunction(value) and old.__module__ == right.__name__:
            put_function(old, value)
        elif inspect.isclass(value) and value.__module__ == right.__name__:
            for key, method in vars(value).items():
                if inspect.isfunction(method):
                    put_function(vars(old)[key], method)
        elif isinstance(value, (int, float, tuple, dict)) and not name.startswith("__") and repr(value) != repr(old):
            for other in list(sys.modules.values()):
                if getattr(other, "__dict__", {}).get(name) is old:
                    setattr(other, name, value)


def put_function(old, new):
    old, new = inspect.unwrap(old), inspect.unwrap(new)
    old.__defaults__, old.__kwdefaults__ = new.__defaults__, new.__kwdefaults__
    if not old.__code__.co_freevars:
        old.__code__ = new.__code__


class Faults:
    """In place of running the tests once, run them for each fault."""

    def __init__(self, modules):
        self.modules, self.catches = modules, {}

    def pytest_collection(self):
        """A failure need not be made small, and the cases are the same each time."""
        import hypothesis  # not above: pytest rewrites its plugins as they are imported

        phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
        hypothesis.settings.register_profile("faults", hypothesis.settings.get_profile("ci"), phases=phases)
        hypothesis.settings.load_profile("faults")

    def pytest_runtestloop(self, session):
        """First without a fault, to know what each test calls and how long it takes: the quick ones are the first then."""
        seconds, self.calls = {}, {}
        for item in session.items:
            start, calls = process_time(), self.calls.setdefault(item, set())
            sys.setprofile(lambda frame, *_, calls=calls: calls.add(frame.f_code))
            assert passes(item), f"{item.nodeid} fails without a fault"
            sys.setprofile(None)
            calls &= {code for code in calls if Path(code.co_filename).parent == ROOT / "stss_ref"}
            seconds[item] = process_time() - start
        self.items = sorted(session.items, key=seconds.get)
        waiting = [(module, *fault) for module in reversed(self.modules) for fault in faults(module)]
        running = {}
        while waiting or running:
            while waiting and len(running) < (os.cpu_count() or 1):
                module, name, source, function = waiting.pop()
                running[self.begin(module, source, self.concerned(module, function))] = name
            pid, status = os.wait()
            name = running.pop(pid)
            self.catches[name] = status != 0
            if not status and name.rpartition(",")[0] not in SAME:
                print(f"{name}  SURVIVES", flush=True)
        return True

    def concerned(self, module, function):
        """The tests that call a function of a module; any function of it, where none is named."""
        return [
            item
            for item in self.items
            if any(Path(c.co_filename).stem == module and function in (None, c.co_name) for c in self.calls[item])
        ] or self.items

    def begin(self, module, source, items):
        """The id of a process that ends with 0 where nothing is found."""
        if pid := os.fork():
            return pid
        status = 1
        try:
            signal.setitimer(signal.ITIMER_PROF, LONGEST)
            plant(module, source)
            status = 0 if all(map(passes, items)) else 1
        finally:
            os._exit(status)


def passes(item):
    """Whether a test passes; its fixtures are made anew."""
    return not any(report.failed for report in runtestprotocol(item, log=False, nextitem=None))


def main():
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "CI": "1"}
    os.chdir(ROOT)
    start, faulty = perf_counter(), Faults(sys.argv[1:] or MODULES)
    options = ["-q", "-p", "no:cacheprovider", "-s", "tests/ref", "--ignore", "tests/ref/test_reference_data.py"]
    pytest.main(options, plugins=[faulty])
    survivors = [name for name, is_caught in faulty.catches.items() if not is_caught]
    same = [name for name in survivors if name.rpartition(",")[0] in SAME]
    fault_count = len(faulty.catches) - len(same)
    print(
        f"{fault_count + len(same) - len(survivors)} of {fault_count} found by tests/ref, {perf_counter() - start:.0f} s;",
        end=" ",
    )
    print(f"{len(same)} others change nothing")
    sys.exit(1 if len(survivors) > len(same) or not faulty.catches else 0)


if __name__ == "__main__":
    main()
