# SPDX-License-Identifier: MIT
"""The suite in a pytest run of the user's own, with pytest's options, reports and JUnit: docs/conformance.md.

Pytest finds it by the suite's ``conftest.py`` where the suite is given as a folder; an installed one is named:
``pytest -p conformance.pytest_plugin --pyargs conformance.suite --port package.module:factory``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conformance import OLDEST_HYPOTHESIS
from conformance.judging.findings import TestResult
from conformance.judging.judge import TIERS, Judge
from conformance.judging.known_failures import KnownFailuresError, read_known
from conformance.options import PortChoice
from conformance.protocol.load_port import ARITHMETICS, load_port
from conformance.report.failures import keep_failure
from conformance.suite.run_suite import JUDGED, SUITE, SuitePlugin, require_known
from stss_ground.errors import InputError
from stss_ground.optional import require
from stss_ground.shell import join_words

FAILURES = Path("conform-failures")
NAME = "stss-suite"


def pytest_addoption(parser: pytest.Parser) -> None:
    """The options of ``stss conform`` that choose a port and its cases."""
    group = parser.getgroup("stss", "a port of space-time supersampling")
    group.addoption("--port", metavar="MODULE:FACTORY", help="a Python object: package.module:factory")
    group.addoption("--exec", metavar="PROGRAM", help="a program that is called with a job folder")
    group.addoption("--tier", choices=[*TIERS], default="quick", help="the number of cases")
    group.addoption("--seed", type=int, default=0, help="another seed draws other cases")
    group.addoption("--dtype", choices=ARITHMETICS, help="the port's arithmetic")
    group.addoption("--winograd", action="store_true", help="the port computes convolutions by Winograd's method")
    group.addoption("--weights-version", type=int, help="the latest version of weights that the port knows")
    group.addoption(
        "--start-timeout", type=float, default=PortChoice.timeout, metavar="SECONDS", help="for one start of a program"
    )
    group.addoption(
        "--known-failures", type=Path, metavar="FILE", help="JSON file of tests that may fail, each with a last day and a reason"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Load the port, and let its judge take the results."""
    if config.option.help or config.option.version:
        return
    options = config.option
    try:
        require("hypothesis", "conform", OLDEST_HYPOTHESIS)
        choice = PortChoice(
            options.port, options.exec, options.start_timeout, options.dtype, options.winograd, options.weights_version
        )
        port, abilities = load_port(choice)
        failures = read_known(options.known_failures) if options.known_failures is not None else []
        require_known(failures)
    except (InputError, KnownFailuresError) as error:
        raise pytest.UsageError(str(error)) from error
    judge = Judge(port, TIERS[options.tier], options.seed, abilities=abilities)
    again = choice.command()

    def keep(result: TestResult, _: int) -> None:
        if result.outcome in ("failed", "error") and result.record.failure is not None:
            folder = keep_failure(FAILURES, result.id, result.record.failure, again)
            result.message += f"\n{again} --replay {join_words([str(folder)])}"

    # The user's own settings for warnings do not count: wrong numbers give some. Whole weights are not printed.
    config.addinivalue_line("filterwarnings", "ignore")
    np.set_printoptions(threshold=0, edgeitems=1)
    config.pluginmanager.register(SuitePlugin(judge, failures, set(SUITE), on_result=keep), NAME)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """With pytest-xdist the workers have the results: take the result that one of them sends at its end; a crashed one sends none."""
    plugin: Any = node.config.pluginmanager.get_plugin(NAME)
    judged, error = getattr(node, "workeroutput", {}).get(NAME, (False, None))
    plugin.judged_elsewhere |= judged
    plugin.error = plugin.error or error


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """A run that compared nothing with a bound, or whose failures could not be kept, does not pass."""
    plugin: Any = session.config.pluginmanager.get_plugin(NAME)
    if plugin is not None and hasattr(session.config, "workeroutput"):
        session.config.workeroutput[NAME] = plugin.has_judged, plugin.error and str(plugin.error)
    if plugin is not None and session.exitstatus == pytest.ExitCode.OK and _amiss(plugin):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print these messages."""
    plugin: Any = config.pluginmanager.get_plugin(NAME)
    for line in _amiss(plugin) if plugin is not None else ():
        terminalreporter.write_line(line)


def _amiss(plugin: SuitePlugin) -> list[str]:
    faults = [f"a failure could not be kept: {plugin.error}"] if plugin.error is not None else []
    return [result.message for result in plugin.results if result.id == JUDGED] + faults
