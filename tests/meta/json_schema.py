"""The part of JSON Schema that our schemas use, so that tests need no package for it; an unknown word is an error, not a pass."""

import re

TYPES = {
    "object": dict, "array": list, "string": str, "boolean": bool, "null": type(None), "integer": int, "number": (int, float),
}  # fmt: skip
WORDS = {"$schema", "title", "description", "format"}
"""That say nothing of what is valid."""


def is_of(value, name):
    return isinstance(value, TYPES[name]) and (name in ("boolean", "object", "array") or not isinstance(value, bool))


def checks(value, schema, where):
    """The word of each rule, and whether it holds; what lies deeper is in ``faults``."""
    yield (
        "type",
        "type" not in schema
        or any(is_of(value, t) for t in ([schema["type"]] if isinstance(schema["type"], str) else schema["type"])),
    )
    yield "const", "const" not in schema or (value == schema["const"] and not isinstance(value, bool))
    yield "enum", "enum" not in schema or value in schema["enum"]
    yield "anyOf", "anyOf" not in schema or any(not faults(value, each, where) for each in schema["anyOf"])
    if isinstance(value, str):
        yield "pattern", re.search(schema.get("pattern", ""), value) is not None
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        yield "minimum", value >= schema.get("minimum", value)
        yield "maximum", value <= schema.get("maximum", value)
    if isinstance(value, list):
        yield "minItems", len(value) >= schema.get("minItems", 0)
    if isinstance(value, dict):
        yield "minProperties", len(value) >= schema.get("minProperties", 0)
        yield "required", set(schema.get("required", ())) <= set(value)
        yield "additionalProperties", schema.get("additionalProperties") is not False or set(value) <= set(schema["properties"])
        yield "propertyNames", not any(faults(key, schema.get("propertyNames", {}), where) for key in value)


KNOWN = WORDS | {
    "type", "const", "enum", "anyOf", "pattern", "minimum", "maximum", "minItems", "minProperties", "required",
    "additionalProperties", "propertyNames", "properties", "items",
}  # fmt: skip


def faults(value, schema, where="$"):
    """Where and by which word a value breaks a schema."""
    assert set(schema) <= KNOWN, set(schema) - KNOWN
    found = [f"{where}: {word}" for word, holds in checks(value, schema, where) if not holds]
    if isinstance(value, list):
        for i, each in enumerate(value):
            found += faults(each, schema.get("items", {}), f"{where}[{i}]")
    if isinstance(value, dict):
        rest = schema.get("additionalProperties", {}) or {}
        for key, each in value.items():
            found += faults(each, schema.get("properties", {}).get(key, rest), f"{where}.{key}")
    return found
