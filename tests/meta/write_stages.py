# SPDX-License-Identifier: MIT
"""``python -m tests.meta.write_stages``: writes what follows from the table of stages, ``conformance/protocol/stages.py``.

That is ``stages.json``, the words of stages in the schemas, and the table of docs/ports.md.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import conformance.report
import stss_ref
from conformance.protocol.array_specs import ArraySpec
from conformance.protocol.layers import LAYERS_OF
from conformance.protocol.stages import STAGES, Stage
from conformance.suite.run_suite import SUITE
from tests.meta.tables import put_between

SCHEMAS = Path(conformance.report.__file__).parent / "schemas"
PAGE = Path(__file__).parents[2] / "docs" / "ports.md"
COMMAND = "python -m tests.meta.write_stages"
DESCR = {"float": "<f4", "uint8": "|u1", "int": "<i4"}
KINDS = {"float": "", "uint8": " uint8", "int": " int32"}
BESIDE = {*SUITE, "suite"} - {*STAGES}
"""Words that a schema may allow where it allows all stages."""

Specs = Mapping[str, ArraySpec]


def stage_table() -> Any:
    """``stages.json``."""

    def arrays(specs: Specs) -> Any:
        return {
            name: {"shape": [str(dim) if dim.letter else dim.times for dim in spec.dims], "descr": DESCR[spec.kind]}
            for name, spec in specs.items()
        }

    stages = {
        stage.name: {
            "weights": stage.weights,
            "inputs": arrays(stage.inputs),
            "outputs": arrays(stage.outputs),
            "layers": arrays(LAYERS_OF.get(stage.name, {})),
        }
        for stage in STAGES.values()
    }
    return {"format": 1, "specification": stss_ref.SPEC_VERSION, "stages": stages}


def with_stages(schema: Any) -> Any:
    """The schema with today's stages wherever it lists stages."""
    if isinstance(schema, dict):
        return {key: with_stages(value) for key, value in schema.items()}
    if not isinstance(schema, list):
        return schema
    if any(word in STAGES for word in schema if isinstance(word, str)):
        return [*STAGES, *(word for word in schema if word in BESIDE)]
    return [with_stages(value) for value in schema]


def row(stage: Stage) -> str:
    """The stage's row of docs/ports.md."""

    def cell(specs: Specs) -> str:
        return "<br>".join(f"`{name}` {spec}{KINDS[spec.kind]}" for name, spec in specs.items())

    return f"| `{stage.name}` | {cell(stage.inputs)} | {'yes' if stage.weights else ''} | {cell(stage.outputs)} |"


def texts() -> Iterator[tuple[Path, str]]:
    """Each file, and what it should hold."""
    for path in sorted(SCHEMAS.glob("*.schema.json")):
        text = path.read_text(encoding="utf-8")
        schema = json.loads(text)
        changed = with_stages(schema)
        yield path, text if changed == schema else json.dumps(changed, indent=1) + "\n"
    yield SCHEMAS / "stages.json", json.dumps(stage_table(), indent=1) + "\n"
    if PAGE.exists():  # an installed copy has none
        rows = "\n".join(["| stage | in | weights | out |", "|---|---|---|---|", *map(row, STAGES.values())])
        yield PAGE, put_between(PAGE.read_text(encoding="utf-8"), COMMAND, rows)


if __name__ == "__main__":
    for path, text in texts():
        path.write_text(text, encoding="utf-8")
