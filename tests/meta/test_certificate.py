"""What a port publishes: a certificate that anybody can check, and a badge made of it."""

import json
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner

from conformance.judge import Judge, Tier
from conformance.mistakes import find
from conformance.protocol.stages import STAGES
from conformance.run_suite import SUITE, run_suite
from stss.cli.main import stss
from stss.conform.certificate import certificate, read_certificate
from stss.conform.own_ports import ReferencePort
from stss_ground.errors import InputError
from tests.meta import right_ports

FEW = Tier("quick", 12, 3, 1)
HALF_BROKEN = """
from stss.conform.own_ports import ReferencePort

class Port(ReferencePort):
    def stages(self):
        return frozenset({"warp", "rrm"})
    def run(self, stage, inputs, weights=None):
        out = super().run(stage, inputs, weights)
        if stage == "rrm": out["valid"] = 1 - out["valid"]
        return out
"""


def certified(port, stages=("warp", "rrm"), seed=0):
    judge = Judge(port, FEW, seed, certified=True)
    return certificate(judge, run_suite(judge, stages))


def run(*words):
    return CliRunner().invoke(stss, [str(word) for word in words])


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A certificate's bytes."""
    path = tmp_path_factory.mktemp("certificate") / "c.json"
    done = run("conform", "--port", "stss.port:ReferencePort", "--stages", "rrm", "--certificate", path)
    assert done.exit_code == 0, done.output
    return path.read_bytes()


@pytest.fixture
def made(written, tmp_path, monkeypatch):
    """That certificate in a folder of its own, with a port that is half broken."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "half_broken.py").write_text(HALF_BROKEN)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "c.json").write_bytes(written)
    return tmp_path / "c.json"


def test_it_says_what_was_judged(made):
    found = json.loads(made.read_text())
    assert found["port"] == "ref"
    assert found["versions"].keys() == {"stss", "specification", "python", "numpy", "hypothesis"}
    assert found["not_judged"] == [stage for stage in SUITE if stage != "rrm"]
    stage = found["stages"]["rrm"]
    assert stage["error_over_bound"] == {"rrm.valid": 0}
    assert (stage["largest_height"], stage["largest_width"]) == (301, 300)
    assert found["cases"] == stage["cases"] > 600


def test_the_same_run_gives_the_same_bytes(made):
    again = made.with_name("again.json")
    assert run("conform", "--port", "stss.port:ReferencePort", "--stages", "rrm", "--certificate", again).exit_code == 0
    assert again.read_bytes() == made.read_bytes()


def test_cases_do_not_depend_on_the_port():
    """Another right port has the same digest, other errors; another seed and other stages have others."""
    ours, other = (certified(port) for port in (ReferencePort(), right_ports.port("double")))
    assert ours["cases_sha256"] == other["cases_sha256"]
    assert ours["stages"]["warp"]["error_over_bound"] != other["stages"]["warp"]["error_over_bound"]
    assert certified(ReferencePort(), seed=1)["cases_sha256"] != ours["cases_sha256"]
    warp = certified(ReferencePort(), ["warp"])
    assert warp["cases_sha256"] != ours["cases_sha256"]
    assert warp["stages"]["warp"]["cases_sha256"] == ours["stages"]["warp"]["cases_sha256"]


def test_the_last_bits_of_a_machine_do_not_count(monkeypatch):
    """Cases are digested in float32: their float64 may differ in the last bit."""
    ours = certified(ReferencePort(), ["warp"])["cases_sha256"]
    draw = np.random.Generator.uniform
    monkeypatch.setattr(np.random, "default_rng", lambda seed: _Nudged(draw, seed))
    assert certified(ReferencePort(), ["warp"])["cases_sha256"] == ours


class _Nudged(np.random.Generator):
    def __init__(self, _, seed):
        super().__init__(np.random.PCG64(seed))

    def random(self, *given, **named):
        drawn = super().random(*given, **named)
        return np.nextafter(drawn, 2.0) if isinstance(drawn, np.ndarray) and drawn.dtype == np.float64 else drawn


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--port", "half_broken:Port"], "no certificate: 4 tests failed"),
        (["--port", "half_broken:Port", "--fail-fast"], "no certificate: the run was stopped"),
        (["--port", "half_broken:Port", "--known-failures", "known"], "no certificate: 4 known failures"),
        (["--port", "half_broken:Port", "--stages", "erm"], "no certificate: 1 test failed"),  # nothing is judged
    ],
)
def test_a_port_that_does_not_conform_gets_none(made, words, why):
    names = [
        "agrees_with_the_reference",
        "twice_is_once",
        "as_many_as_the_rectangle_has",
        "large_frames_agree_with_the_reference",
    ]
    entries = [{"test": f"rrm.{name}", "until": "2999-01-01", "reason": "x"} for name in names]
    made.with_name("known").write_text(json.dumps({"format": 1, "failures": entries}))
    stages = [] if "--stages" in words else ["--stages", "rrm"]
    done = run("conform", *words, *stages, "--certificate", "none.json")
    assert done.exit_code == 1
    assert why in done.output
    assert not made.with_name("none.json").exists()


def test_a_mistake_gets_none_either(made):
    assert (
        run("conform", "--port", "conformance.mistakes:rrm_filled", "--stages", "rrm", "--certificate", "no.json").exit_code == 1
    )
    assert find("rrm_filled").stage == "rrm"
    assert not made.with_name("no.json").exists()


def test_a_badge(made):
    done = run("badge", made, "-o", "b.svg")
    assert done.exit_code == 0, done.output
    root = ElementTree.parse("b.svg").getroot()
    texts = [each.text for each in root.iter("{http://www.w3.org/2000/svg}text")]
    assert texts == ["stss spec 2", "rrm, float32, quick"]
    assert run("badge", made, "-o", "b.json").exit_code == 0
    endpoint = json.loads(made.with_name("b.json").read_text())
    assert endpoint == {"schemaVersion": 1, "label": texts[0], "message": texts[1], "color": "yellowgreen"}


def test_the_badge_of_a_whole_port(made):
    whole = json.loads(made.read_text())
    whole["stages"] = dict.fromkeys(SUITE, whole["stages"]["rrm"])
    made.write_text(json.dumps({**whole, "winograd": True}))
    assert "all stages, float32, Winograd, quick" in run("badge", made, "-o", "b.json").output
    assert json.loads(made.with_name("b.json").read_text())["color"] == "green"
    assert set(SUITE) > set(STAGES)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected JSON"),
        ("[" * 99999, "expected JSON"),
        ("[]", "expected a certificate"),
        ('{"format": 1}', "expected a certificate"),
        ("{}", "expected a certificate"),
    ],
)
def test_what_is_no_certificate(tmp_path, text, words):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(InputError, match=re.escape(words)):
        read_certificate(tmp_path / "c.json")


@pytest.mark.parametrize(
    "change",
    [
        {"stages": {}}, {"stages": {"<script>": {}}}, {"stages": 7}, {"dtype": "<b>"}, {"tier": "some"}, {"format": 2},
        {"versions": {"specification": "<b>"}}, {"versions": {"specification": 2}}, {"versions": None},
    ],
)  # fmt: skip
def test_a_tampered_one_is_refused(made, change):
    made.write_text(json.dumps({**json.loads(made.read_text()), **change}))
    with pytest.raises(InputError, match="expected a certificate"):
        read_certificate(made)


def test_a_badge_of_another_kind_is_refused(made):
    assert "ends with .svg or .json" in str(run("badge", made, "-o", "b.png").exception)
    assert "the same file as" in str(run("badge", made, "-o", made).exception)
