# SPDX-License-Identifier: MIT
"""The weights file of a job: only ports that go by the names pass, and the library reads every file."""

import json
from dataclasses import replace

import numpy as np
import pytest

from conformance.cases.stage_inputs import WEIGHT_KINDS, make_weights
from conformance.judging.judge import Judge, Tier
from conformance.protocol.job_folder import read_weights
from conformance.protocol.port import Case
from conformance.protocol.weights_file import serialise, shuffle
from conformance.protocol.weights_format import CHOICES, VERSION_KEY, VERSIONS, format_metadata, versions_of
from conformance.reference_port import ReferencePort
from conformance.suite.run_suite import run_suite
from stss_ref.weights import TENSORS, Weights
from tests.tiers import thorough

SETS = [make_weights("random", seed) for seed in range(16)]


def header(data):
    """Its bytes, and their content."""
    length = int.from_bytes(data[:8], "little")
    return data[8 : 8 + length], json.loads(data[8 : 8 + length])


def test_the_library_reads_them(tmp_path):
    for own in SETS:
        weights = replace(own, second_color="detail", hole_test="paper")
        copy = read_weights(serialise(weights), tmp_path)
        assert (copy.second_color, copy.hole_test) == ("detail", "paper")
        assert all(np.array_equal(copy[name], weights[name]) for name in TENSORS)
        assert serialise(weights) == serialise(shuffle(weights))


def test_no_two_are_laid_out_alike():
    """Metadata first, last and between; tensors, entries and what is in one in any order; more spaces behind, or none."""
    texts, headers = zip(*(header(serialise(weights)) for weights in SETS), strict=True)
    places = {[*names].index("__metadata__") for names in headers}
    assert {0, len(TENSORS)} < places
    assert len({tuple(names) for names in headers}) == len(SETS)
    orders = [sorted(TENSORS, key=lambda name, names=names: names[name]["data_offsets"]) for names in headers]
    assert len({tuple(names) for names in orders}) == len(SETS)
    assert len({tuple(names["outc.bias"]) for names in headers}) > 2
    assert {len(text) % 8 for text in texts} == {0}
    assert len({len(text) - len(text.rstrip()) for text in texts}) > 3
    assert {len(names["__metadata__"]) for names in headers} == {1, 2}


def test_a_text_of_the_metadata_has_the_words_of_settings():
    """A port that looks for them anywhere in the header finds settings that the weights do not have."""
    texts = [header(serialise(weights))[0] for weights in SETS]
    assert any(all(word in text for word in (b"paper", b"detail", b"reshade")) for text in texts)


def test_a_file_has_any_version_that_has_its_choices():
    kinds = [make_weights(kind, 0) for kind in WEIGHT_KINDS]
    for choices in ({}, {"hole_test": "paper"}, {"second_color": "detail"}, {"hole_fill": "reshade"}):
        sets = [replace(weights, **choices) for weights in kinds]
        assert {shuffle(weights, max(VERSIONS)).version for weights in sets} == {*versions_of(sets[0])}
        assert {shuffle(weights).version for weights in sets} == {versions_of(sets[0])[0]}


class ByVersion(ReferencePort):
    """Takes the version for the choices that it made possible."""

    def __init__(self, **choices):
        self.choices = choices

    def run(self, stage, inputs, weights=None):
        version = int(format_metadata(weights)[VERSION_KEY])
        taken = {name: CHOICES[name][version == first] for name, first in self.choices.items()}
        return super().run(stage, inputs, replace(weights, **taken))


@pytest.mark.parametrize("choice", [{"hole_fill": 5}, thorough({"second_color": 4}), thorough({"hole_test": 3})], ids=str)
def test_a_port_that_goes_by_the_version_is_found(choice):
    judge = Judge(ByVersion(**choice), Tier("some", 1, 24, 0), shrink=False)
    (result,) = run_suite(judge, ["frame"], only="rendered_scenes")
    assert result.outcome == "failed"


class InOrder(ReferencePort):
    """Takes the tensors by their order: that of the names, of the network, or of the first file."""

    def __init__(self, order):
        self.order = order

    def run(self, stage, inputs, weights=None):
        names = self.order or [*weights]
        self.order = names
        return super().run(stage, inputs, Weights(dict(zip(names, weights.values(), strict=True))))


@pytest.mark.parametrize("order", [sorted(TENSORS), [*TENSORS], []], ids=["names", "network", "first"])
def test_a_port_that_goes_by_the_order_is_found(order):
    judge = Judge(InOrder(order), Tier("some", 1, 6, 0), shrink=False)
    (result,) = run_suite(judge, ["history"], only="agrees_with")
    assert result.outcome == "failed"


def test_a_case_keeps_its_file():
    """Weights that were read are written in the same form again."""
    case = Case("history", {}, shuffle(SETS[0]))
    assert serialise(case.weights) == serialise(SETS[0])
