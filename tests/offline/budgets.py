"""Budgets of the kernels on every target. They are above today's figures, since a compiler's next version may need a little more."""

from dataclasses import dataclass

from tests.offline.compilers import is_intel


@dataclass(frozen=True)
class Budget:
    """Registers of a work-item, bytes of stack, bytes of local memory of a group; ``intel``: bytes that Intel's compiler may spill."""

    registers: int = 128
    stack: int = 0
    local: int = 0
    intel: int = 0


DEFAULT = Budget()
STRUCT = 48
"""Bytes of stack: Clang copies an argument that is a struct (layer.clh's) there. NVIDIA's compiler does not: at most 8 on an H200."""
BUDGETS = {
    # 64 sums and what a row of the tile holds; two groups and more on every unit.
    # On Intel four registers, which no loop over channels reads.
    "conv_local": Budget(registers=240, stack=STRUCT, local=31 << 10, intel=128),
    # Sums of 64 pixels x 32 outputs for four times 32 work-items; inputs and weights of as many channels as fit.
    "conv_mma": Budget(registers=224, stack=STRUCT, local=48 << 10),
    "matrix": Budget(local=1 << 10),
    # The keys around a tile of 4 x 4, and 25 weights for each of its pixels.
    "attend_local": Budget(local=12 << 10),
    # Eight rows of the image, above and below 64 columns.
    "image": Budget(local=12 << 10),
    # An alignment of eight bytes.
    **dict.fromkeys(("holes", "prepare_newest", "prepare_older"), Budget(stack=8)),
    # A flag for each of 32 tiles.
    "arrive": Budget(local=128),
    # The plain convolution is the oracle: it may have all registers.
    "conv": Budget(registers=256, stack=STRUCT),
}


def faults(kernel, compiled, target):
    """The figures that exceed the budget, in words."""
    budget = BUDGETS.get(kernel, DEFAULT)
    # Intel's compiler names all registers that there are: what does not fit is spilled.
    registers = 0 if is_intel(target) else compiled.registers
    checks = (
        ("registers", registers, budget.registers),
        ("bytes of stack", compiled.stack, budget.stack),
        ("spilled", compiled.spilled, budget.intel if is_intel(target) else 0),
        ("bytes of local memory", compiled.local, budget.local),
    )
    return [f"{got} {what}, allowed {most}" for what, got, most in checks if got > most]
