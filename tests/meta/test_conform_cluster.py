# SPDX-License-Identifier: MIT
"""``stss conform --cluster``: the report of one process, whatever becomes of the workers."""

import json
import os
import re
import signal
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest
from click.testing import CliRunner

from conformance.judge import TIERS, Tier
from conformance.run_suite import run_suite
from stss.cli.main import stss
from stss.cluster.client import ANY_PORT
from stss.cluster.conform import PortIntroduction, judged_on_cluster
from stss.conform.load_port import GivenPort, Judging
from stss.conform.versions import versions_of_cases
from stss_ground.errors import InputError

distributed = pytest.importorskip("distributed", reason="the extra cluster is not installed")

PORTS = """
import os
from stss.conform.own_ports import ReferencePort

class Wrong(ReferencePort):
    name = "wrong"
    def stages(self):
        return frozenset({"rrm", "history"})
    def run(self, stage, inputs, weights=None):
        got = super().run(stage, inputs, weights)
        if stage == "rrm" and got["valid"].shape[1] > 3:
            return {"valid": 1 - got["valid"]}
        return {name: array * 1.01 for name, array in got.items()} if stage == "history" else got

class Ends(Wrong):
    def run(self, stage, inputs, weights=None):
        os._exit(3)
"""
FEW = Tier("quick", 12, 2, 1)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A scheduler and two workers, started in a folder with ports in it; the tests are in it as well."""
    folder, before = tmp_path_factory.mktemp("ports"), Path.cwd()
    (folder / "some_ports.py").write_text(PORTS)
    os.chdir(folder)
    try:
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, worker_dashboard_address=None, silence_logs=50, memory_limit=0,
            scheduler_kwargs={**ANY_PORT, "allowed_failures": 1},
        ) as processes:  # fmt: skip
            yield processes
    finally:
        os.chdir(before)


@pytest.fixture(autouse=True)
def few_cases(monkeypatch):
    monkeypatch.setitem(TIERS, "quick", FEW)


def run(*words):
    return CliRunner().invoke(stss, ["conform", *words])


def judging(port):
    return Judging(GivenPort(port, None, 60, None, False), Tier("some", 60, 2, 1), 0, 1, False)


def told(results):
    """All of them but the time they took."""
    return [(r.id, r.property, r.outcome, r.message, r.record.cases, r.record.worst) for r in results]


def test_the_report_is_that_of_one_process(cluster):
    """JSON, JUnit, status, and each failure's folder byte for byte, also of a stage with weights."""
    left = []
    for where in ((), ("--cluster", cluster.scheduler_address)):
        done = run(
            "--port", "some_ports:Wrong", "--stages", "rrm,warp,history", "--json", "found.json", "--junit", "junit.xml", *where
        )
        assert done.exit_code == 1, done.output
        found = json.loads(Path("found.json").read_text())
        for test in found["tests"]:
            assert (test.pop("seconds") > 0) or test["outcome"] == "skipped"
        suite = ElementTree.parse("junit.xml").getroot()[0]
        counted = {name: suite.get(name) for name in ("tests", "failures", "errors", "skipped")}
        failures = {str(path): path.read_bytes() for path in Path("conform-failures").rglob("*") if path.is_file()}
        left.append((found, counted, failures, done.output))
    assert {test["outcome"] for test in left[0][0]["tests"]} == {"passed", "failed", "skipped"}
    assert left[1] == left[0]


def test_a_certificate_is_that_of_one_process(cluster):
    for name, where in (("alone.json", ()), ("many.json", ("--cluster", cluster.scheduler_address))):
        done = run("--port", "stss.port:ReferencePort", "--stages", "rrm", "--certificate", name, *where)
        assert done.exit_code == 0, done.output
    assert Path("many.json").read_bytes() == Path("alone.json").read_bytes()


def test_tests_of_a_worker_that_dies_are_run_again(cluster):
    """A worker is killed in the middle of a test."""
    killed = []

    def kill(result, total):
        del result, total
        client = cluster.get_client()
        busy = [address for address, keys in client.processing().items() if keys]
        if not killed and busy:
            killed.append(client.run(os.getpid, workers=busy[:1], nanny=False)[busy[0]])
            os.kill(killed[0], signal.SIGKILL)

    given = judging("stss.port:ReferencePort")
    with judged_on_cluster(cluster.scheduler_address, given) as (judge, elsewhere):
        many = run_suite(judge, ["rrm", "warp"], elsewhere=elsewhere, on_result=kill)
    assert killed, "nobody was killed: all tests were done"
    assert told(many) == told(run_suite(given.judge(), ["rrm", "warp"]))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": "other"}, "workers' ports differ: name: other; wrong"),
        ({"dtype": "float16"}, "workers' ports differ: dtype: float16; float32"),
        ({"winograd": True}, "workers' ports differ: winograd: False; True"),
        ({"stages": frozenset({"warp"})}, "workers' ports differ: stages: rrm, warp; warp"),
        ({"versions": {**versions_of_cases(), "numpy": "0.1"}}, r"worker b: expected numpy .*, as here, found 0.1: other cases"),
        ({"error": "no such port"}, "worker b: no such port"),
    ],
)
def test_workers_that_differ_are_refused(monkeypatch, change, said):
    one = PortIntroduction(versions_of_cases(), "wrong", "float32", False, frozenset({"warp", "rrm"}))
    crew = SimpleNamespace(introductions=lambda: {"a": one, "b": replace(one, **change)})
    monkeypatch.setattr("stss.cluster.conform.connected", lambda address: nullcontext())
    monkeypatch.setattr("stss.cluster.conform.crew", lambda client, make: nullcontext(crew))
    with pytest.raises(InputError, match=said), judged_on_cluster("anywhere", judging("some_ports:Wrong")):
        pass


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--port", "some_ports:Nothing", "--cluster", "HERE"], r"worker tcp://.*: --port some_ports:Nothing: .* has no Nothing"),
        (["--exec", "./no_such_program", "--cluster", "HERE"], r"worker tcp://.*: ./no_such_program: cannot be started"),
        (["--cluster", "HERE"], "expected either --port"),
        (["--port", "some_ports:Wrong", "--replay", "x", "--cluster", "HERE"], "--cluster: expected neither --replay nor"),
        (["--port", "some_ports:Wrong", "--cluster", "nowhere"], "--cluster: expected local:N or a scheduler"),
    ],
)
def test_mistakes_are_one_line(cluster, words, said):
    done = run(*(cluster.scheduler_address if word == "HERE" else word for word in words))
    assert isinstance(done.exception, InputError), done.exception
    assert re.match(said, str(done.exception))
    assert "\n" not in str(done.exception)


def test_a_port_that_ends_its_process_is_an_error(cluster, monkeypatch):
    """The last test here: dask does not start a worker again that dies while it starts."""
    monkeypatch.setattr("stss.cluster.client.WAIT", 5)
    with judged_on_cluster(cluster.scheduler_address, judging("some_ports:Ends")) as (judge, elsewhere):
        results = run_suite(judge, ["rrm", "warp"], elsewhere=elsewhere)
    assert {r.outcome for r in results if r.stage == "rrm"} == {"error"}
    assert all("every worker" in r.message for r in results if r.stage == "rrm")
    assert {r.outcome for r in results if r.stage == "warp"} == {"skipped"}
