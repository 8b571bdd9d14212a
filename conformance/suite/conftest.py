# SPDX-License-Identifier: MIT
"""``python -m pytest conformance/suite --port package.module:factory``: the tests by pytest alone, with its own options such as ``-k``."""

from __future__ import annotations

import pytest

from conformance.judging.judge import TIERS, Judge
from conformance.protocol.load_port import load_port
from conformance.protocol.stages import STAGES
from stss_ground.errors import UserError

SEQUENCE_STAGE = "frame"


def pytest_addoption(parser: pytest.Parser) -> None:
    """The port, and how it is judged: as options of ``stss conform``."""
    group = parser.getgroup("port", "the port that is judged")
    group.addoption("--port", metavar="MODULE:FACTORY", help="a Python object: package.module:factory")
    group.addoption("--exec", metavar="PROGRAM", help="a program that is called with a job folder")
    group.addoption("--tier", choices=sorted(TIERS), default="quick", help="how many cases")
    group.addoption("--case-seed", type=int, default=0, help="another seed draws other cases")
    group.addoption("--dtype", choices=["float32", "float16", "bfloat16"], help="the port's arithmetic")
    group.addoption("--winograd", action="store_true", help="it computes convolutions by Winograd's method")
    group.addoption("--start-timeout", type=float, default=120, help="seconds for one start of a program")


@pytest.fixture(scope="session")
def judge_of_port(request: pytest.FixtureRequest) -> Judge:
    """The judge of the port that the options name."""
    option = request.config.option
    try:
        port = load_port(option.port, option.exec, option.start_timeout, option.dtype, option.winograd)
    except UserError as error:
        pytest.exit(str(error), pytest.ExitCode.USAGE_ERROR)
    return Judge(port, TIERS[option.tier], option.case_seed)


@pytest.fixture
def judge(judge_of_port: Judge, request: pytest.FixtureRequest) -> Judge:
    """The same with an empty record; the test is skipped if the port lacks its stage."""
    stage = request.path.stem.removeprefix("test_")
    needed = stage if stage in STAGES else SEQUENCE_STAGE
    if needed not in judge_of_port.stages:
        pytest.skip(f"the port has no stage {needed}")
    judge_of_port.begin()
    return judge_of_port
