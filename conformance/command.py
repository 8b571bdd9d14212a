# SPDX-License-Identifier: MIT
"""``stss conform``, and ``stss`` where the judge is installed alone."""

from __future__ import annotations

import faulthandler
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from conformance import OLDEST_HYPOTHESIS
from stss_ground.arguments import suggest
from stss_ground.commands import Subcommand, refuse_options
from stss_ground.errors import InputError
from stss_ground.exit_status import run_guarded
from stss_ground.freed_memory import keep_freed_memory
from stss_ground.one_thread import take_one_thread
from stss_ground.option_kinds import MAX_SECONDS, MAX_SEED, Names, Number, Program, ReadPath, Size, WrittenFile, WrittenFolder
from stss_ground.optional import require as require_package
from stss_ground.optional import require_own_conformance
from stss_ground.output.places import require_places
from stss_ground.shell import join_words
from stss_ground.terminal import echo
from stss_ground.version import VERSION

MAX_REPEAT = 1000
MOST_PIXELS = 3840 * 2160
LEAST_SIDE = 2048
"""Rows and columns that every port must accept: textures have had this size for long, and only made cases have more."""
MOST_SIDE = 2**17
OF_STAGES = (
    *("stages", "size", "largest_side", "weights_version", "require", "repeat", "fail_fast", "known_failures", "write_cases"),
)
OF_MODELS = ("shapes", "files")
"""Parameters that hold only for a port of our network, and those only for a port of any network."""


@click.command(cls=Subcommand)
@click.option("--port", "spec", metavar="MODULE:FACTORY", help="A Python object: package.module:factory.")
@click.option(
    "--exec", "program", type=Program(), metavar="PROGRAM", help='A program that is called with a job folder: "./port --gpu 1".'
)
@click.option(
    "--onnx", type=ReadPath(), help="Judge a port of this network, an ONNX model, in place of ours (docs/any-network.md)."
)
@click.option(
    "--shape",
    "shapes",
    metavar="NAME=N",
    multiple=True,
    help="With --onnx: the size of an open axis; without it the size is drawn.",
)
@click.option(
    "--input", "files", type=Program(), metavar="NAME=FILE.npy", multiple=True, help="With --onnx: judge only these inputs."
)
@click.option("--stages", type=Names(), help="Stages to judge  [default: all that the port has]")
@click.option(
    "--tier",
    type=click.Choice(["quick", "full"]),
    default="quick",
    show_default=True,
    help="Number and size of cases: a few, or many and large ones.",
)
@click.option("--size", type=Size(MOST_SIDE, MOST_PIXELS), help="Judge each stage once at this size, too.")
@click.option(
    "--largest-side",
    type=click.IntRange(LEAST_SIDE, MOST_SIDE),
    help="Cut cases to the largest side that the port accepts.",
)
@click.option("--seed", type=click.IntRange(0, MAX_SEED), default=0, show_default=True, help="Another seed draws other cases.")
@click.option(
    "--dtype",
    type=click.Choice(["float32", "float16", "bfloat16"]),
    help="The port's arithmetic  [default: the port's own statement, else float32]",
)
@click.option("--winograd", is_flag=True, help="The port computes convolutions by Winograd's method: wider bounds for them.")
@click.option(
    "--weights-version",
    type=int,
    help="Latest version of weights files that the port knows  [default: the port's own statement, else the latest of all]",
)
@click.option(
    "--timeout", type=Number(0, MAX_SECONDS, min_open=True), default=120, show_default=True, help="Seconds for one start."
)
@click.option("--require", type=Names(), help="Stages that the port must have.")
@click.option(
    "--repeat", type=click.IntRange(1, MAX_REPEAT), default=1, show_default=True, help="Compute each case this many times."
)
@click.option("--fail-fast", is_flag=True, help="Stop at the first failure.")
@click.option("--known-failures", type=ReadPath(), help="JSON file of tests that may fail, each with a last day and a reason.")
@click.option(
    "--failures",
    type=WrittenFolder(),
    default=Path("conform-failures"),
    show_default=True,
    help="Folder for the cases that fail.",
)
@click.option("--replay", type=ReadPath(), help="Run only the case of one folder of --failures again.")
@click.option(
    "--write-cases", type=WrittenFolder(), help="Write cases with right answers and bounds into a new folder, and judge nothing."
)
@click.option("--json", "json_file", type=WrittenFile(), help="File for every result, written as it comes.")
@click.option("--junit", type=WrittenFile(), help="File for JUnit XML.")
@click.option("--report", type=WrittenFile(), help="File for an HTML page with pictures.")
def conform(
    spec: str | None,
    program: str | None,
    onnx: Path | None,
    shapes: tuple[str, ...],
    files: tuple[str, ...],
    stages: tuple[str, ...] | None,
    tier: str,
    size: tuple[int, int] | None,
    largest_side: int | None,
    seed: int,
    dtype: str | None,
    winograd: bool,
    weights_version: int | None,
    timeout: float,
    require: tuple[str, ...] | None,
    repeat: int,
    fail_fast: bool,
    known_failures: Path | None,
    failures: Path,
    replay: Path | None,
    write_cases: Path | None,
    json_file: Path | None,
    junit: Path | None,
    report: Path | None,
) -> None:
    """Judge a port: name the stage that departs from the specification, its error, and the smallest such input.

    Ends with status 0 if no stage departs, 1 if one does or nothing was judged.
    """
    require_package("pytest", "conform")
    require_package("hypothesis", "conform", OLDEST_HYPOTHESIS)
    if not faulthandler.is_enabled():
        faulthandler.enable(2)  # native code of a Python port may end this process: its line is then printed
    choice = PortChoice(spec, program, dtype, winograd, weights_version, timeout)
    if onnx is not None:
        refuse_options("with --onnx", OF_STAGES)
        cases = ModelCases(shapes, files, replay, tier, seed)
        sys.exit(_judge_model(onnx, choice, cases, failures, (json_file, junit, report)))
    refuse_options("without --onnx", OF_MODELS)
    from conformance.judging.judge import TIERS, Judge
    from conformance.judging.known_failures import KnownFailuresError, read_known
    from conformance.protocol.load_port import loaded_files
    from conformance.report import case_archive
    from conformance.report.running_report import RunningReport
    from conformance.suite.run_suite import SUITE, run_suite, stage_needed

    _require_folder(failures)
    _require_stages({"--stages": stages, "--require": require})
    if write_cases is not None:
        if spec is not None or program is not None:
            raise InputError("--write-cases: expected neither --port nor --exec: what is right depends on no port")
        to_write = [stage for stage in SUITE if stages is None or stage in stages]
        index = case_archive.write_cases(
            write_cases, to_write, TIERS[tier], seed, dtype or "float32", winograd=winograd, tell=echo
        )
        echo(f"{write_cases}: {len(index['cases'])} cases, inputs {index['inputs_sha256'][:16]}")
        return
    needs = {stage_needed(stage) for stage in (*(stages or SUITE), *(require or ()))}
    port, abilities = choice.load(needs if replay is None else SUITE)
    # The modules that the port has imported are read, too.
    require_places({"--json": json_file, "--junit": junit, "--report": report}, loaded_files())
    if replay is not None:
        sys.exit(_replay(port, abilities, replay))
    judge = Judge(port, TIERS[tier], seed, repeat=repeat, size=size, largest_side=largest_side, abilities=abilities)
    try:
        excuses = read_known(known_failures) if known_failures is not None else ()
        running = RunningReport(judge, failures, choice.command(), json_file)
        with running:
            run_suite(
                judge,
                stages or SUITE,
                known_failures=excuses,
                required_stages=require or (),
                first_only=fail_fast,
                on_result=running.take,
            )
    except KnownFailuresError as error:
        raise InputError(str(error)) from error
    except OSError as error:
        raise InputError(f"{error.filename or known_failures}: {error.strerror or error}") from error
    sys.exit(0 if running.finish(report, junit) else 1)


@dataclass(frozen=True)
class PortChoice:
    """The user's choice of a port, and of its abilities: the options of these names."""

    spec: str | None
    program: str | None
    dtype: str | None
    winograd: bool
    weights_version: int | None
    timeout: float

    def load(self, stages: Iterable[str]) -> tuple[Any, Any]:
        """See `conformance.protocol.load_port.load_port`."""
        from conformance.protocol.load_port import load_port

        return load_port(self.spec, self.program, self.timeout, self.dtype, self.winograd, self.weights_version, stages)

    def command(self, onnx: Path | None = None) -> str:
        """The command that judges this port, without ``--replay``."""
        words = [
            "stss",
            "conform",
            *(("--onnx", str(onnx)) if onnx is not None else ()),
            *(("--port", self.spec) if self.spec is not None else ("--exec", self.program or "")),
        ]
        words += ["--dtype", self.dtype] if self.dtype is not None else []
        if self.weights_version is not None and onnx is None:
            words += ["--weights-version", str(self.weights_version)]
        return join_words([*words, *(["--winograd"] if self.winograd else [])])


@dataclass(frozen=True)
class ModelCases:
    """The cases that a port of any network is judged on: the options of these names."""

    shapes: tuple[str, ...]
    files: tuple[str, ...]
    replay: Path | None
    tier: str
    seed: int

    def sizes(self) -> dict[str, int]:
        """The sizes of open axes; InputError for a word that names none."""
        sizes: dict[str, int] = {}
        for each in self.shapes:
            name, _, number = each.rpartition("=")
            if not name or not number.isdecimal() or not 0 < int(number) <= MOST_SIDE:
                raise InputError(f"--shape: expected NAME=N with N from 1 to {MOST_SIDE}, got {each!r}")
            sizes[name] = int(number)
        return sizes


def _judge_model(
    path: Path, choice: PortChoice, cases: ModelCases, failures: Path, reports: tuple[Path | None, Path | None, Path | None]
) -> int:
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

    sizes = cases.sizes()
    _require_folder(failures)
    model, replay = load_model(path), cases.replay
    inputs = [read_case(model, cases.files)] if cases.files else [] if replay is None else read_failure(model, replay)
    port = load_graph_port(model, choice.spec, choice.program, choice.timeout)
    # The modules that the port has imported are read, too.
    require_places(dict(zip(("--json", "--junit", "--report"), reports, strict=True)), loaded_files())
    dtype = choice.dtype or model.dtype
    options = {"dtype": dtype, "winograd": choice.winograd, "tier": cases.tier, "seed": cases.seed}
    rounding, command = Rounding(Arithmetic(dtype, choice.winograd)), choice.command(path)
    outcome = judge_port(model, port, rounding, tier=cases.tier, seed=cases.seed, fixed=sizes, own_inputs=inputs)
    print_outcome(outcome, Terminal())
    folder = None
    if outcome.failure is not None and replay is None:
        try:
            folder = keep_failure(failures, path.name, outcome.failure, command, write_model_case)
        except InputError as error:
            echo(f"not kept: {error}; --failures takes another folder")
        else:
            echo(f"{command} --replay {join_words([str(folder)])}")
    write_files(outcome, model, port, options, folder, *reports)
    return 0 if outcome.passes else 1


def _require_stages(stages_of: dict[str, tuple[str, ...] | None]) -> None:
    from conformance.suite.run_suite import SUITE

    for option, names in stages_of.items():
        if unknown := sorted(set(names or ()) - set(SUITE)):
            near = suggest(unknown[0], SUITE)
            raise InputError(f"{option}: expected some of {', '.join(SUITE)}, got {', '.join(unknown)}{near}")


def _require_folder(failures: Path) -> None:
    """Raise InputError if ``failures`` cannot be a folder; called before minutes of work."""
    if failures.exists() and not failures.is_dir():
        raise InputError(f"{failures}: expected a folder, found a file")


def _replay(port: Any, abilities: Any, folder: Path) -> int:
    from conformance.report.failures import replay

    record = replay(port, folder, abilities)
    for output, ratio in record.worst.items():
        echo(f"{output}: {'wrong' if ratio == float('inf') else f'error / bound {ratio:.3g}'}")
    if record.failure is not None:
        echo(record.failure.finding.message)
    elif not record.worst:
        echo("nothing was judged: rounding decides on the whole answer")
    return int(record.failure is not None or not record.worst)


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
