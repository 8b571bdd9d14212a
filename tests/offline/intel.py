"""Intel's offline compiler, ocloc: what it says about the kernels of a program. IGC, which it calls, writes a folder of listings."""

import re
from pathlib import Path


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
    """Registers (of 32 bytes, as many as the compiler was told), bytes of stack, of spills, of local memory."""

    def number(pattern, text):
        match = re.search(pattern, text)
        return int(match[1]) if match else 0

    return {
        "registers": number(r"numGRF=(\d+)", assembly),
        "stack": number(r"PerThreadPrivateMemorySize\s*= (\d+)", description),
        "spilled": number(r"//\.spill size (\d+)", assembly),
        "local": number(r"TotalInlineLocalMemorySize\s*= (\d+)", description),
    }
