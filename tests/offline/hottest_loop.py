"""The hottest loop of a kernel in a GPU's own instructions: the innermost one with the most multiply-adds."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

MULTIPLY_ADD = re.compile(r"FFMA|HFMA2|HMMA|v_(pk_)?fma|v_fmac|v_mac|v_wmma|v_mfma|v_dot2|v_dual_fmac")
MEMORY = re.compile(r"LD|ST|global_|ds_|s_load|buffer_|scratch_|flat_")


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
        """Of multiply-adds among all."""
        return self.multiply_adds / self.instructions if self.instructions else 0.0


def hottest(code: Sequence[Instruction]) -> Loop:
    """The innermost loop with most multiply-adds; where there is no loop, the whole kernel."""
    at = {line.label: i for i, line in enumerate(code) if not line.name}
    jumps = [(at[line.label], i) for i, line in enumerate(code) if line.name and at.get(line.label, i) < i]
    inner = [(a, b) for a, b in jumps if not any((c, d) != (a, b) and a <= c and d <= b for c, d in jumps)]
    loops = [_counted(code[a : b + 1]) for a, b in inner] or [_counted(code)]
    return max(loops, key=lambda loop: loop.multiply_adds)


def _counted(code: Sequence[Instruction]) -> Loop:
    kinds: Counter[str] = Counter()
    for line in code:
        if line.name:
            kinds["all"] += 1
            kinds["multiply_adds"] += bool(MULTIPLY_ADD.match(line.name))
            kinds["memory"] += bool(MEMORY.match(line.name))
    return Loop(kinds["all"], kinds["multiply_adds"], kinds["memory"])


def nvidia(text: str, kernel: str) -> list[Instruction]:
    """What nvdisasm prints of one kernel."""
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
    """What clang's assembly has of one kernel."""
    body = text.split(f"\n{kernel}:", 1)[-1].split("\n.Lfunc_end", 1)[0]
    found: list[Instruction] = []
    for line in body.splitlines():
        if label := re.match(r"(\.LBB\d+_\d+):", line):
            found.append(Instruction("", label[1]))
        elif told := re.match(r"\s+([a-z][a-z0-9_]+)(.*)", line):
            target = re.search(r"\.LBB\d+_\d+", told[2]) if "branch" in told[1] else None
            found.append(Instruction(told[1], target[0] if target else "", told[2]))
    return found
