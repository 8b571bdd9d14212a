"""Intel's offline compiler, ocloc: what it says about the kernels of a program. IGC, which it calls, writes a folder of listings."""

import re
from pathlib import Path

from tests.offline import hottest_loop
from tests.offline.hottest_loop import Instruction


def listings(folder):
    """The listing and the description of each kernel: kernel -> (assembly, description).

    A kernel that spilled may be compiled once more, in another way: only what runs has a description.
    """
    found = {}
    for path in sorted(Path(folder).glob("*.asm")):
        text = path.read_text(encoding="utf-8", errors="replace")
        kernel, description = re.search(r"^//\.kernel (\w+)", text, re.MULTILINE), path.with_suffix(".cos")
        if kernel and description.exists():
            found[kernel[1]] = text, description.read_text(encoding="utf-8", errors="replace")
    return found


def figures(assembly, description):
    """Registers (of 32 bytes, as many as the compiler was told), bytes of stack, of spills, of local memory; the hottest loop."""

    def number(pattern, text):
        match = re.search(pattern, text)
        return int(match[1]) if match else 0

    return {
        "registers": number(r"numGRF=(\d+)", assembly),
        "stack": number(r"PerThreadPrivateMemorySize\s*= (\d+)", description),
        "spilled": number(r"//\.spill size (\d+)", assembly),
        "local": number(r"TotalInlineLocalMemorySize\s*= (\d+)", description),
        "loop": hottest_loop.hottest(instructions(assembly)),
    }


def instructions(assembly):
    """The instructions of one kernel. Multiply-adds of integers have the same name as those of floats, and are left out."""
    found = []
    for line in assembly.splitlines():
        if label := re.match(r"(L\d+|_\d+_\d+):", line):
            found.append(Instruction("", label[1]))
        elif told := re.match(r"(?:\([^)]*\))?\s+([a-z][a-z0-9_.]*)\s(.*)", line):
            name = "integer" if told[1].startswith("mad") and ":f" not in told[2] else told[1]
            target = re.findall(r"\b(?:L\d+|_\d+_\d+)\b", told[2]) if told[1].startswith(("goto", "jmpi", "while", "br")) else []
            found.append(Instruction(name, target[-1] if target else "", told[2]))
    return found
