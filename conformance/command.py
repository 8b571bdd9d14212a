# SPDX-License-Identifier: MIT
"""``stss conform``, and ``stss`` where the judge is installed alone."""

from __future__ import annotations

import faulthandler
import sys
from pathlib import Path
from typing import Any

import click

from conformance import OLDEST_HYPOTHESIS
from conformance.options import MOST_SIDE, CaseChoice, NetworkChoice, PortChoice, ReportFiles, VerdictChoice
from stss_ground.arguments import suggest
from stss_ground.commands import Subcommand, gather_options, refuse_options
from stss_ground.errors import InputError
from stss_ground.exit_status import run_guarded
from stss_ground.freed_memory import keep_freed_memory
from stss_ground.one_thread import take_one_thread
from stss_ground.option_kinds import MAX_SECONDS, MAX_SEED, Names, Number, Program, ReadPath, Size, WrittenFile, WrittenFolder
from stss_ground.optional import require as require_package
from stss_ground.optional import require_own_conformance
from stss_ground.shell import join_words
from stss_ground.terminal import echo
from stss_ground.version import VERSION

MAX_REPEAT = 1000
MOST_PIXELS = 3840 * 2160
LEAST_SIDE = 2048
"""Rows and columns that every port must accept: textures have had this size for long, and only made cases have more."""
OF_STAGES = (
    *("stages", "size", "largest_side", "weights_version", "require", "repeat", "fail_fast", "known_failures", "write_cases"),
)
OF_MODELS = ("shapes", "files")
"""Parameters that hold only for a port of our network, and those only for a port of any network."""


@click.command(cls=Subcommand)
@gather_options(
    "The port",
    "port",
    PortChoice,
    click.option("--port", "spec", metavar="MODULE:FACTORY", help="A Python object: package.module:factory."),
    click.option(
        "--exec",
        "program",
        type=Program(),
        metavar="PROGRAM",
        help='A program that is called with a job folder: "./port --gpu 1".',
    ),
    click.option(
        "--dtype",
        type=click.Choice(["float32", "float16", "bfloat16"]),
        help="The port's arithmetic  [default: the port's own statement, else float32]",
    ),
    click.option("--winograd", is_flag=True, help="The port computes convolutions by Winograd's method: wider bounds for them."),
    click.option(
        "--weights-version",
        type=int,
        help="Latest version of weights files that the port knows  [default: the port's own statement, else the latest of all]",
    ),
    click.option(
        "--timeout",
        type=Number(0, MAX_SECONDS, min_open=True),
        default=PortChoice.timeout,
        show_default=True,
        help="Seconds for one start.",
    ),
)
@gather_options(
    "Another network than ours",
    "network",
    NetworkChoice,
    click.option(
        "--onnx", type=ReadPath(), help="Judge a port of this network, an ONNX model, in place of ours (docs/any-network.md)."
    ),
    click.option(
        "--shape",
        "shapes",
        metavar="NAME=N",
        multiple=True,
        help="With --onnx: the size of an open axis; without it the size is drawn.",
    ),
    click.option(
        "--input", "files", type=Program(), metavar="NAME=FILE.npy", multiple=True, help="With --onnx: judge only these inputs."
    ),
)
@gather_options(
    "The cases",
    "cases",
    CaseChoice,
    click.option("--stages", type=Names(), help="Stages to judge  [default: all that the port has]"),
    click.option(
        "--tier",
        type=click.Choice(["quick", "full"]),
        default="quick",
        show_default=True,
        help="Number and size of cases: a few, or many and large ones.",
    ),
    click.option(
        "--seed", type=click.IntRange(0, MAX_SEED), default=0, show_default=True, help="Another seed draws other cases."
    ),
    click.option("--size", type=Size(MOST_SIDE, MOST_PIXELS), help="Judge each stage once at this size, too."),
    click.option(
        "--largest-side",
        type=click.IntRange(LEAST_SIDE, MOST_SIDE),
        help="Cut cases to the largest side that the port accepts.",
    ),
    click.option(
        "--repeat", type=click.IntRange(1, MAX_REPEAT), default=1, show_default=True, help="Compute each case this many times."
    ),
    click.option("--replay", type=ReadPath(), help="Run only the case of one folder of --failures again."),
    click.option(
        "--write-cases",
        type=WrittenFolder(),
        help="Write cases with right answers and bounds into a new folder, and judge nothing.",
    ),
)
@gather_options(
    "The verdict",
    "verdict",
    VerdictChoice,
    click.option("--require", type=Names(), help="Stages that the port must have."),
    click.option(
        "--known-failures", type=ReadPath(), help="JSON file of tests that may fail, each with a last day and a reason."
    ),
    click.option("--fail-fast", is_flag=True, help="Stop at the first failure."),
)
@gather_options(
    "The report",
    "files",
    ReportFiles,
    click.option(
        "--failures",
        type=WrittenFolder(),
        default=Path("conform-failures"),
        show_default=True,
        help="Folder for the cases that fail.",
    ),
    click.option("--json", "json_file", type=WrittenFile(), help="File for every result, written as it comes."),
    click.option("--junit", type=WrittenFile(), help="File for JUnit XML."),
    click.option("--report", "page", type=WrittenFile(), help="File for an HTML page with pictures."),
)
def conform(port: PortChoice, network: NetworkChoice, cases: CaseChoice, verdict: VerdictChoice, files: ReportFiles) -> None:
    """Judge a port: name the stage that departs from the specification, its error, and the smallest such input.

    Ends with status 0 if no stage departs, 1 if one does or nothing was judged.
    """
    require_package("pytest", "conform")
    require_package("hypothesis", "conform", OLDEST_HYPOTHESIS)
    if not faulthandler.is_enabled():
        faulthandler.enable(2)  # native code of a Python port may end this process: its line is then printed
    if network.onnx is not None:
        refuse_options("not with --onnx", OF_STAGES)
        passes = _judge_model(network.onnx, network, port, cases, files)
    else:
        refuse_options("only with --onnx", OF_MODELS)
        files.require_folder()
        _require_stages({"--stages": cases.stages, "--require": verdict.require})
        if cases.write_cases is not None:
            _write_cases(cases.write_cases, port, cases)
            return
        passes = _judge_stages(port, cases, verdict, files)
    sys.exit(0 if passes else 1)


def _judge_model(path: Path, network: NetworkChoice, choice: PortChoice, cases: CaseChoice, files: ReportFiles) -> bool:
    """Judge a port of another network; whether it passes."""
    from conformance.answers.port_arithmetic import Arithmetic
    from conformance.graph.cases import read_case, read_failure
    from conformance.graph.model import load_model
    from conformance.graph.ports import load_graph_port, write_model_case
    from conformance.graph.report import print_outcome, write_files
    from conformance.graph.rounding import Rounding
    from conformance.graph.run import judge_port
    from conformance.protocol.load_port import loaded_files
    from conformance.report.failures import keep_failure
    from stss_ground.terminal import Terminal

    sizes = network.sizes()
    files.require_folder()
    model, replay = load_model(path), cases.replay
    inputs = [read_case(model, network.files)] if network.files else [] if replay is None else read_failure(model, replay)
    port = load_graph_port(model, choice)
    files.require_apart(loaded_files())
    dtype = choice.dtype or model.dtype
    options = {"dtype": dtype, "winograd": choice.winograd, "tier": cases.tier, "seed": cases.seed}
    rounding, command = Rounding(Arithmetic(dtype, choice.winograd)), choice.command(path)
    outcome = judge_port(model, port, rounding, tier=cases.tier, seed=cases.seed, fixed=sizes, own_inputs=inputs)
    print_outcome(outcome, Terminal())
    folder = None
    if outcome.failure is not None and replay is None:
        try:
            folder = keep_failure(files.failures, path.name, outcome.failure, command, write_model_case)
        except InputError as error:
            echo(f"not kept: {error}; --failures takes another folder")
        else:
            echo(f"{command} --replay {join_words([str(folder)])}")
    write_files(outcome, model, port, options, folder, files)
    return outcome.passes


def _write_cases(folder: Path, port: PortChoice, cases: CaseChoice) -> None:
    from conformance.judging.judge import TIERS
    from conformance.report import case_archive
    from conformance.suite.run_suite import SUITE

    if port.spec is not None or port.program is not None:
        raise InputError("--write-cases: expected neither --port nor --exec: what is right depends on no port")
    stages = [stage for stage in SUITE if cases.stages is None or stage in cases.stages]
    dtype = port.dtype or "float32"
    index = case_archive.write_cases(folder, stages, TIERS[cases.tier], cases.seed, dtype, winograd=port.winograd, tell=echo)
    echo(f"{folder}: {len(index['cases'])} cases, inputs {index['inputs_sha256'][:16]}")


def _judge_stages(choice: PortChoice, cases: CaseChoice, verdict: VerdictChoice, files: ReportFiles) -> bool:
    """Judge a port of our network; whether it passes."""
    from conformance.judging.judge import TIERS, Judge
    from conformance.judging.known_failures import KnownFailuresError, read_known
    from conformance.protocol.load_port import load_port, loaded_files
    from conformance.report.running_report import RunningReport
    from conformance.suite.run_suite import SUITE, run_suite, stage_needed

    stages, require = cases.stages or SUITE, verdict.require or ()
    port, abilities = load_port(choice, SUITE if cases.replay is not None else {*map(stage_needed, (*stages, *require))})
    files.require_apart(loaded_files())
    if cases.replay is not None:
        return _replay(port, abilities, cases.replay)
    judge = Judge(
        port,
        TIERS[cases.tier],
        cases.seed,
        repeat=cases.repeat,
        size=cases.size,
        largest_side=cases.largest_side,
        abilities=abilities,
    )
    known = verdict.known_failures
    try:
        excuses = read_known(known) if known is not None else ()
        running = RunningReport(judge, files, choice.command())
        with running:
            run_suite(
                judge,
                stages,
                known_failures=excuses,
                required_stages=require,
                first_only=verdict.fail_fast,
                on_result=running.take,
            )
    except KnownFailuresError as error:
        raise InputError(str(error)) from error
    except OSError as error:
        raise InputError(f"{error.filename or known}: {error.strerror or error}") from error
    return running.finish()


def _require_stages(stages_of: dict[str, tuple[str, ...] | None]) -> None:
    from conformance.suite.run_suite import SUITE

    for option, names in stages_of.items():
        if unknown := sorted(set(names or ()) - set(SUITE)):
            near = suggest(unknown[0], SUITE)
            raise InputError(f"{option}: expected some of {', '.join(SUITE)}, got {', '.join(unknown)}{near}")


def _replay(port: Any, abilities: Any, folder: Path) -> bool:
    """Judge a case again; whether it passes."""
    from conformance.report.failures import replay

    record = replay(port, folder, abilities)
    for output, ratio in record.worst.items():
        echo(f"{output}: {'wrong' if ratio == float('inf') else f'error / bound {ratio:.3g}'}")
    if record.failure is not None:
        echo(record.failure.finding.message)
    elif not record.worst:
        echo("nothing was judged: rounding decides on the whole answer")
    return record.failure is None and bool(record.worst)


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120})
@click.version_option(VERSION, prog_name="stss")
def judge_alone() -> None:
    """Judge ports of space-time supersampling: the part of stss that needs neither OpenCL nor image files."""
    require_own_conformance()


judge_alone.add_command(conform)


def main() -> None:
    """Run the command."""
    take_one_thread()
    keep_freed_memory()
    from stss_ref.arrays import ArrayError
    from stss_ref.weights import WeightsError

    run_guarded(judge_alone, ArrayError, WeightsError)
