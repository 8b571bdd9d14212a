"""The hottest loop of a kernel in a GPU's own instructions: the one with the most multiply-adds of its own."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

MULTIPLY_ADD = re.compile(r"FFMA|HFMA2|HMMA|v_(pk_)?fma|v_fmac|v_mac|v_dot2|v_dual_fmac|mad")
MATRICES = re.compile(r"HMMA")
MEMORY = re.compile(r"LD|ST|global_|ds_|s_load|buffer_|scratch_|flat_|load|store|send")
BARRIER = re.compile(r"BAR|s_barrier|sync.bar")


@dataclass(frozen=True)
class Instruction:
    """One of them; ``label`` of the place it may jump to, or its own where ``name`` is empty."""

    name: str
    label: str = ""
    operands: str = ""


@dataclass(frozen=True)
class Loop:
    """Instructions of one turn: all, multiply-adds (of matrix units, too), loads and stores."""

    instructions: int
    multiply_adds: int
    memory: int

    @property
    def share(self) -> float:
        """Share of multiply-adds among all instructions."""
        return self.multiply_adds / self.instructions if self.instructions else 0.0


def hottest(code: Sequence[Instruction]) -> Loop:
    """The loop with most multiply-adds of its own, those of loops within it not counted; where there is no loop, the whole kernel.

    Products of matrices go before all others. Where they are written out one behind the other, between barriers, only what lies between
    them counts.
    """
    at = {line.label: i for i, line in enumerate(code) if not line.name}
    jumps = sorted({(at[line.label], i) for i, line in enumerate(code) if line.name and at.get(line.label, i) < i})
    loops: list[Sequence[Instruction]] = []
    for first, last in jumps:
        inner = [(a, b) for a, b in jumps if (a, b) != (first, last) and first <= a and b <= last]
        loops.append(_without(code, first, last, inner))
    products = [body for body in loops if any(MATRICES.match(line.name) for line in body)]
    found = [_counted(_between_products(body)) for body in products or loops or [code]]
    return max(found, key=lambda loop: loop.multiply_adds)


def _between_products(code: Sequence[Instruction]) -> Sequence[Instruction]:
    """The instructions from the first product of matrices to the last, if there are some, and barriers around them; else all."""
    at = [i for i, line in enumerate(code) if MATRICES.match(line.name)]
    return code[at[0] : at[-1] + 1] if at and any(BARRIER.match(line.name) for line in code) else code


def _without(code: Sequence[Instruction], first: int, last: int, inner: Sequence[tuple[int, int]]) -> list[Instruction]:
    return [code[i] for i in range(first, last + 1) if not any(c <= i <= d for c, d in inner)]


def _counted(code: Sequence[Instruction]) -> Loop:
    kinds: Counter[str] = Counter()
    for line in code:
        if line.name:
            kinds["all"] += 1
            kinds["multiply_adds"] += bool(MULTIPLY_ADD.match(line.name))
            kinds["memory"] += bool(MEMORY.match(line.name))
    return Loop(kinds["all"], kinds["multiply_adds"], kinds["memory"])


def nvidia(text: str, kernel: str) -> list[Instruction]:
    """The instructions of one kernel, from nvdisasm's output."""
    body = re.split(r"\n\s*\.section|\n//-----", text.split(f".text.{kernel}:", 1)[-1])[0]
    found: list[Instruction] = []
    for line in body.splitlines():
        if label := re.match(r"(\.L_x_\d+):", line):
            found.append(Instruction("", label[1]))
        elif told := re.match(r"\s+/\*[0-9a-f]{4,}\*/\s+(?:@!?U?P\w+ )?\s*([A-Z][A-Z0-9_.]*)(.*)", line):
            target = re.search(r"\.L_x_\d+", told[2]) if told[1].startswith("BRA") else None
            found.append(Instruction(told[1], target[0] if target else "", told[2]))
    return found


def amd(text: str, kernel: str) -> list[Instruction]:
    """The instructions of one kernel, from clang's assembly."""
    body = text.split(f"\n{kernel}:", 1)[-1].split("\n.Lfunc_end", 1)[0]
    found: list[Instruction] = []
    for line in body.splitlines():
        if label := re.match(r"(\.LBB\d+_\d+):", line):
            found.append(Instruction("", label[1]))
        elif told := re.match(r"\s+([a-z][a-z0-9_]+)(.*)", line):
            target = re.search(r"\.LBB\d+_\d+", told[2]) if "branch" in told[1] else None
            found.append(Instruction(told[1], target[0] if target else "", told[2]))
    return found
